"""The state carried on by the IMU, and the path that it took: points of a sweep are moved along it.

Samples count in the middle of each step. Where samples are missing the motion between them is taken as even,
and its uncertainty is that of an unknown acceleration.
Source: Xu et al., FAST-LIO2, T-RO 2022, section IV-C.
"""

from __future__ import annotations

import numpy as np

from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.odometry.lidar_inertial.state import (
    ACCEL_BIAS,
    GRAVITY,
    GYRO_BIAS,
    PLACE,
    SIZE,
    TURN,
    VELOCITY,
    LidarInertialState,
)
from mapstream.operators.odometry.visual_inertial.propagation import (
    UNMEASURED_MPS2,
    UNMEASURED_RADPS,
    Motion,
)
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import hat, so3_exp
from mapstream.streams.trajectory import Trajectory


def propagate(state: LidarInertialState, motion: Motion, imu: ImuQuality) -> Trajectory:
    """Carry the state to the end of the samples, which begin where it is; return T_odom_imu at each sample."""
    poses, middles, v = _integrated(state, motion)
    _spread(state, middles, motion, imu)
    state.R, state.p, state.v = poses[-1, :3, :3], poses[-1, :3, 3], v
    state.stamp_ns = int(motion.stamps_ns[-1])
    return Trajectory(stamps_ns=motion.stamps_ns, poses=poses)


def way_to(state: LidarInertialState, motion: Motion) -> Trajectory:
    """Return T_odom_imu at each of the samples, which end where the state is."""
    back = Motion(
        motion.stamps_ns[::-1], motion.gyro[::-1], motion.accel[::-1], motion.is_gap[::-1]
    )
    poses, _, _ = _integrated(state, back)
    return Trajectory(stamps_ns=motion.stamps_ns, poses=poses[::-1])


def _integrated(
    state: LidarInertialState, motion: Motion
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return T_odom_imu (N, 4, 4) at the samples, attitudes (N - 1, 3, 3) in the middle of steps, the last velocity.

    Time may run backwards.
    """
    dt = motion.steps_s
    rates, forces = motion.midway()
    rates, forces = rates - state.gyro_bias, forces - state.accel_bias
    halves, wholes = so3_exp(rates * (dt / 2)[:, None]), so3_exp(rates * dt[:, None])
    poses = np.repeat(np.eye(4)[None], len(dt) + 1, axis=0)
    middles = np.empty((len(dt), 3, 3))
    R, p, v = state.R, state.p, state.v
    poses[0, :3, :3], poses[0, :3, 3] = R, p
    for k, step_s in enumerate(dt.tolist()):
        middles[k] = R @ halves[k]
        acceleration = middles[k] @ forces[k] + state.gravity
        p = p + v * step_s + acceleration * (step_s**2 / 2)
        v = v + acceleration * step_s
        R = R @ wholes[k]
        poses[k + 1, :3, :3], poses[k + 1, :3, 3] = R, p
    return poses, middles, v


def _spread(
    state: LidarInertialState, middles: FloatArray, motion: Motion, imu: ImuQuality
) -> None:
    """Carry the covariance along."""
    dt = motion.steps_s
    rates, forces = motion.midway()
    turns = so3_exp((rates - state.gyro_bias) * dt[:, None])
    gyro = np.where(motion.is_gap, UNMEASURED_RADPS**2 * dt**2, imu.gyro_density**2 * dt)
    accel = np.where(motion.is_gap, UNMEASURED_MPS2**2 * dt**2, imu.accel_density**2 * dt)
    by_turn = -middles @ hat(forces - state.accel_bias)
    F, P, one = np.eye(SIZE), state.covariance, np.eye(3)
    for k, step_s in enumerate(dt.tolist()):
        F[TURN, TURN] = turns[k].T
        F[TURN, GYRO_BIAS] = -step_s * one
        F[PLACE, VELOCITY] = F[VELOCITY, GRAVITY] = step_s * one
        F[VELOCITY, TURN] = step_s * by_turn[k]
        F[VELOCITY, ACCEL_BIAS] = -step_s * middles[k]
        F[PLACE, TURN], F[PLACE, ACCEL_BIAS] = (
            step_s / 2 * F[VELOCITY, TURN],
            step_s / 2 * F[VELOCITY, ACCEL_BIAS],
        )
        F[PLACE, GRAVITY] = step_s**2 / 2 * one
        P = F @ P @ F.T
        P[TURN, TURN] += gyro[k] * one
        P[VELOCITY, VELOCITY] += accel[k] * one
        P[PLACE, PLACE] += accel[k] * step_s**2 / 3 * one
    total_s = float(dt.sum())
    P[GYRO_BIAS, GYRO_BIAS] += imu.gyro_random_walk**2 * total_s * one
    P[ACCEL_BIAS, ACCEL_BIAS] += imu.accel_random_walk**2 * total_s * one
    state.covariance = P
