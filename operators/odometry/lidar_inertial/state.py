"""What the filter estimates, and how sure it is: pose, velocity, biases, and which way gravity pulls.

Gravity is a part of the state, because the map is made in the attitude of the first scan: if that was not
quite level the map cannot turn any more, but gravity can.
The error of the attitude is perturbed on the right, R = R_estimate exp(error); all others are added.
Source: Xu et al., FAST-LIO2: Fast Direct LiDAR-inertial Odometry, T-RO 2022, section IV-A.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, so3_exp

TURN, PLACE, VELOCITY, GYRO_BIAS, ACCEL_BIAS, GRAVITY = (slice(k, k + 3) for k in range(0, 18, 3))
POSE = slice(0, 6)
SIZE = 18
_KNOWN = 1e-6  # sigma of the first pose, which is the frame's by definition, and of gravity's size


@dataclass(slots=True, eq=False)
class LidarInertialState:
    """Mutable: the filter's memory. The covariance has the order of the fields."""

    stamp_ns: int
    R: FloatArray  # (3, 3) R_odom_imu
    p: FloatArray  # (3,) [m]
    v: FloatArray  # (3,) [m/s], odom frame
    gyro_bias: FloatArray  # (3,) [rad/s]
    accel_bias: FloatArray  # (3,) [m/s^2]
    gravity: FloatArray  # (3,) [m/s^2], odom frame
    covariance: FloatArray  # (18, 18)

    @property
    def T_odom_imu(self) -> SE3:
        return SE3.from_rotation(self.R, self.p)

    def corrected(self, error: FloatArray, covariance: FloatArray) -> LidarInertialState:
        """Return the state moved by an error (18,)."""
        return LidarInertialState(
            stamp_ns=self.stamp_ns,
            R=self.R @ so3_exp(error[TURN]),
            p=self.p + error[PLACE],
            v=self.v + error[VELOCITY],
            gyro_bias=self.gyro_bias + error[GYRO_BIAS],
            accel_bias=self.accel_bias + error[ACCEL_BIAS],
            gravity=self.gravity + error[GRAVITY],
            covariance=covariance,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sigmas:
    """How far a first state may be from the truth."""

    velocity_mps: float
    gyro_bias_radps: float
    accel_bias_mps2: float
    tilt_rad: float  # of gravity against the first attitude


def first_state(
    stamp_ns: int, T_odom_imu: SE3, v: FloatArray, gravity: FloatArray, sigmas: Sigmas
) -> LidarInertialState:
    """Return a state whose pose is known, and whose biases are zero."""
    spreads = (_KNOWN, _KNOWN, sigmas.velocity_mps, sigmas.gyro_bias_radps, sigmas.accel_bias_mps2)
    covariance = np.diag(np.repeat((*spreads, _KNOWN), 3) ** 2)
    size = float(np.linalg.norm(gravity))
    down = gravity / size
    covariance[GRAVITY, GRAVITY] += (sigmas.tilt_rad * size) ** 2 * (
        np.eye(3) - np.outer(down, down)
    )
    return LidarInertialState(
        stamp_ns=stamp_ns,
        R=T_odom_imu.R,
        p=T_odom_imu.t,
        v=v,
        gyro_bias=np.zeros(3),
        accel_bias=np.zeros(3),
        gravity=gravity,
        covariance=covariance,
    )
