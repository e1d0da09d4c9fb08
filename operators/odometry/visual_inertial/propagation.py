"""The filter's state carried on by the IMU.

Samples count in the middle of each step. In the errors of `state` the transition does not depend on the
attitude; the biases enter through where the IMU is. Where samples are missing the motion between them is
taken as even, and its uncertainty is that of an unknown acceleration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.odometry.visual_inertial.state import (
    ACCEL_BIAS,
    GYRO_BIAS,
    NUM_INERTIAL,
    FilterState,
)
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import hat, so3_exp

UNMEASURED_RADPS, UNMEASURED_MPS2 = 0.5, 3.0  # in a gap: how far rate and force may be from a line


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """IMU samples between two stamps, with values at both."""

    stamps_ns: IntArray  # (N,) N >= 2
    gyro: FloatArray  # (N, 3) [rad/s]
    accel: FloatArray  # (N, 3) [m/s^2]
    is_gap: np.ndarray[tuple[int], np.dtype[np.bool_]]  # (N - 1,) steps without a measurement

    @property
    def steps_s(self) -> FloatArray:
        return np.asarray(np.diff(self.stamps_ns) / 1e9)

    def midway(self) -> tuple[FloatArray, FloatArray]:
        """Return rates and forces (N - 1, 3) in the middle of the steps."""
        return (self.gyro[1:] + self.gyro[:-1]) / 2, (self.accel[1:] + self.accel[:-1]) / 2


def propagate(state: FilterState, motion: Motion, imu: ImuQuality) -> None:
    """Carry the state to the end of the samples, which begin where it is."""
    dt = motion.steps_s
    rates, forces = motion.midway()
    rates, forces = rates - state.gyro_bias, forces - state.accel_bias
    halves, wholes = so3_exp(rates * (dt / 2)[:, None]), so3_exp(rates * dt[:, None])
    gravity = np.array([0.0, 0.0, -imu.gravity_mps2])
    R, p, v = state.R, state.p, state.v
    middles = np.empty((len(dt), 3, 3))
    places, velocities = np.empty((len(dt), 3)), np.empty((len(dt), 3))
    for k, step in enumerate(dt.tolist()):
        middles[k] = R @ halves[k]
        acceleration = middles[k] @ forces[k] + gravity
        places[k], velocities[k] = p + v * (step / 2), v + acceleration * (step / 2)
        p = p + v * step + acceleration * (step**2 / 2)
        v = v + acceleration * step
        R = R @ wholes[k]
    remaining = (motion.stamps_ns[-1] - motion.stamps_ns[1:]) / 1e9 + dt / 2
    by_gyro, by_accel = _influence(middles, places, velocities, remaining, imu.gravity_mps2)
    transition = np.eye(NUM_INERTIAL)
    transition[:9, :9] = _transition(float(dt.sum()), imu.gravity_mps2)
    transition[:9, GYRO_BIAS] = np.einsum("kij,k->ij", by_gyro, dt)
    transition[:9, ACCEL_BIAS] = np.einsum("kij,k->ij", by_accel, dt)
    gyro_noise = np.where(motion.is_gap, (UNMEASURED_RADPS * dt) ** 2, imu.gyro_density**2 * dt)
    accel_noise = np.where(motion.is_gap, (UNMEASURED_MPS2 * dt) ** 2, imu.accel_density**2 * dt)
    noise = np.zeros((NUM_INERTIAL, NUM_INERTIAL))
    noise[:9, :9] = np.einsum("kij,kmj,k->im", by_gyro, by_gyro, gyro_noise)
    noise[:9, :9] += np.einsum("kij,kmj,k->im", by_accel, by_accel, accel_noise)
    total_s = float(dt.sum())
    noise[GYRO_BIAS, GYRO_BIAS] = np.eye(3) * imu.gyro_random_walk**2 * total_s
    noise[ACCEL_BIAS, ACCEL_BIAS] = np.eye(3) * imu.accel_random_walk**2 * total_s
    P = state.covariance
    P[:NUM_INERTIAL] = transition @ P[:NUM_INERTIAL]
    P[:, :NUM_INERTIAL] = P[:, :NUM_INERTIAL] @ transition.T
    P[:NUM_INERTIAL, :NUM_INERTIAL] += noise
    state.R, state.p, state.v, state.stamp_ns = R, p, v, int(motion.stamps_ns[-1])


def _transition(duration_s: float, gravity_mps2: float) -> FloatArray:
    """Return how errors of turn, place and velocity (9, 9) go on when nothing is added."""
    pull = hat([0.0, 0.0, -gravity_mps2])
    Phi = np.eye(9)
    Phi[3:6, 6:9] = np.eye(3) * duration_s
    Phi[6:9, 0:3] = pull * duration_s
    Phi[3:6, 0:3] = pull * (duration_s**2 / 2)
    return Phi


def _influence(
    R: FloatArray, p: FloatArray, v: FloatArray, remaining_s: FloatArray, gravity_mps2: float
) -> tuple[FloatArray, FloatArray]:
    """Return what a unit error of rate and of force, lasting a second at each step, does at the end: (K, 9, 3)."""
    pull = hat([0.0, 0.0, -gravity_mps2])
    left = remaining_s[:, None, None]
    turn, place, speed = -R, -hat(p) @ R, -hat(v) @ R
    by_gyro = np.concatenate(
        [turn, place + speed * left + pull @ turn * left**2 / 2, speed + pull @ turn * left], axis=1
    )
    by_accel = np.concatenate([np.zeros_like(R), -R * left, -R], axis=1)
    return by_gyro, by_accel
