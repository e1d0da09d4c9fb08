"""First states: of a robot that stands, of one that moves, and of one of which nothing is known yet.

At rest the accelerometer shows what is up, and the gyroscope its bias. In motion poses and samples together say
velocity and gravity (`bias_estimate`). All states are at the origin of a frame whose z is up.
"""

from __future__ import annotations

import numpy as np

from mapstream.operators.imu.bias_estimate import PoseNoise, estimate_start
from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.imu.samples import level_attitude
from mapstream.operators.odometry.lidar_inertial.state import (
    LidarInertialState,
    Sigmas,
    first_state,
)
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import ImuBatch

_LIKELY_BIAS_MPS2 = 0.1  # of the accelerometer; over a second or two a larger one passes for a tilt
_POSE_NOISE = PoseNoise(sigma_rad=0.003, sigma_m=0.02)


def resting(samples: ImuBatch, stamp_ns: int, imu: ImuQuality) -> LidarInertialState:
    """Return the state at a stamp of a robot that stood during the samples."""
    sigmas = Sigmas(
        velocity_mps=0.05,
        gyro_bias_radps=0.01,
        accel_bias_mps2=imu.accel_bias_sigma_mps2,
        tilt_rad=0.03,
    )
    up = samples.accel_mps2.mean(axis=0)
    state = _levelled(stamp_ns, np.eye(3), up, np.zeros(3), imu, sigmas)
    state.gyro_bias = samples.gyro_radps.mean(axis=0)
    return state


def guessed(
    samples: ImuBatch, velocity: FloatArray, stamp_ns: int, imu: ImuQuality
) -> LidarInertialState:
    """Return a state from which scans can be followed for a while, though next to nothing is known.

    Args:
        samples: Around the stamp.
        velocity: (3,) in the axes of the IMU [m/s], a guess.
        stamp_ns: Of the state.
        imu: Its noise.
    """
    sigmas = Sigmas(
        velocity_mps=10.0,
        gyro_bias_radps=imu.gyro_bias_sigma_radps,
        accel_bias_mps2=1e-3,
        tilt_rad=0.5,
    )
    up = samples.accel_mps2.mean(axis=0)
    return _levelled(stamp_ns, np.eye(3), up, velocity, imu, sigmas)


def moving(
    stamps_ns: IntArray, T_odom_imu: FloatArray, samples: ImuBatch, imu: ImuQuality
) -> LidarInertialState:
    """Return the state at the first of some poses (N, 4, 4), which samples cover."""
    likely = imu.model_copy(
        update={"accel_bias_sigma_mps2": min(imu.accel_bias_sigma_mps2, _LIKELY_BIAS_MPS2)}
    )
    found = estimate_start(stamps_ns, T_odom_imu, samples, likely, _POSE_NOISE)
    sigmas = Sigmas(
        velocity_mps=0.3,
        gyro_bias_radps=3 * found.gyro_sigma_radps,
        accel_bias_mps2=imu.accel_bias_sigma_mps2,
        tilt_rad=0.05,
    )
    R, velocity = T_odom_imu[0, :3, :3], found.velocity_mps[0]
    state = _levelled(int(stamps_ns[0]), R, found.up, velocity, imu, sigmas)
    state.gyro_bias = found.gyro_bias_radps
    return state


def _levelled(
    stamp_ns: int, R: FloatArray, up: FloatArray, v: FloatArray, imu: ImuQuality, sigmas: Sigmas
) -> LidarInertialState:
    """Return a state in a frame whose z is up, from attitude, direction up and velocity in any frame."""
    level = level_attitude(up / np.linalg.norm(up))
    gravity = np.array([0.0, 0.0, -imu.gravity_mps2])
    return first_state(stamp_ns, SE3.from_rotation(level @ R), level @ v, gravity, sigmas)
