"""What an IMU says between two vertices, in a form that many guesses of the state share.

Errors are seen from the base: rotation, position, velocity, and the biases of accelerometer and gyroscope. Then how
they spread depends on the samples alone, and on no state (Barrau and Bonnabel, The invariant extended Kalman filter
as a stable observer, TAC 2017), so that one matrix does for all guesses.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from mapstream.operators.estimation.noise import Factor
from mapstream.streams.arrays import FloatArray

STATE = 15  # directions: rotation, position, velocity, bias of the accelerometer, of the gyroscope
ROTATION, POSITION, VELOCITY, BIASES = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 15)


@dataclass(frozen=True, slots=True, eq=False)
class InertialStep:
    """The motion of the base over a while, free of where it begins, how fast, and of gravity."""

    seconds: float
    R: FloatArray  # (3, 3)
    p: FloatArray  # (3,) in the axes of the first base [m]
    v: FloatArray  # (3,) the same [m/s]
    biases: FloatArray  # (6,) that it was integrated with, the accelerometer's first
    transition: FloatArray  # (15, 15) of errors seen from the base
    noise: FloatArray  # (15, 15) that is new at the end
    gravity: FloatArray  # (3,) [m/s^2]


def inertial_step(factor: Factor, gravity_mps2: float) -> InertialStep:
    """Return what the factor of an IMU edge says."""
    integral = factor.preintegratedMeasurements()
    biases = integral.biasHat()
    end = integral.predict(gtsam.NavState(), biases)
    a, v_a, b, v_b, b_a, b_b = factor.keys()
    values = gtsam.Values()
    for pose, velocity, bias, state in ((a, v_a, b_a, gtsam.NavState()), (b, v_b, b_b, end)):
        values.insert(pose, state.pose())
        values.insert(velocity, state.velocity())
        values.insert(bias, biases)
    jacobian, _ = factor.linearize(values).jacobian()  # columns in the order of the keys
    by_first = np.hstack([jacobian[:, :9], jacobian[:, 18:24]])
    by_second = np.hstack([jacobian[:, 9:18], jacobian[:, 24:]])
    R = end.pose().rotation().matrix()
    seen = np.eye(STATE)
    seen[VELOCITY, VELOCITY] = R.T  # gtsam's velocities are seen from outside
    root = seen @ np.linalg.inv(by_second)
    seconds, gravity = integral.deltaTij(), np.array([0.0, 0.0, -gravity_mps2])
    return InertialStep(
        seconds=seconds,
        R=R,
        p=end.pose().translation() - 0.5 * gravity * seconds**2,
        v=end.velocity() - gravity * seconds,
        biases=np.concatenate([biases.accelerometer(), biases.gyroscope()]),
        transition=-root @ by_first,
        noise=root @ root.T,
        gravity=gravity,
    )
