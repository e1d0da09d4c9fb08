"""The first state of a filter, from a robot that stands.

The accelerometer shows what is up, the gyroscope its bias. How far gravity is from a bias of the
accelerometer is left to the filter, whose first covariance is wide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.imu.samples import level_attitude
from mapstream.operators.odometry.visual.rays import Rays
from mapstream.operators.odometry.visual_inertial.propagation import Motion
from mapstream.operators.odometry.visual_inertial.standstill import is_still
from mapstream.operators.odometry.visual_inertial.state import (
    PLACE,
    TURN,
    VELOCITY,
    FilterState,
)
from mapstream.streams.geometry import SE3, hat, so3_exp

_REST_S = 0.4  # so long it must stand
_BLIND_REST_S = 1.0  # the same, if no camera can tell
_REST_RADPS, _REST_MPS2 = 0.02, 0.25  # by which halves of the samples may differ
_TILT_RAD, _SPEED_MPS, _GYRO_BIAS_RADPS = 0.1, 0.05, 0.01  # first sigmas
_FIXED = 1e-4  # of place and heading, which are zero by definition


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """An n-frame that waits for the filter's start."""

    stamp_ns: int
    rays: Rays


def start_at_rest(held: list[Held], motion: Motion, imu: ImuQuality) -> FilterState | None:
    """Return the state at the first n-frame; None if the robot does not stand, or not for long enough.

    Args:
        held: In order.
        motion: Samples from the first to the last.
        imu: Its noise.
    """
    duration_s = float(motion.steps_s.sum())
    seen_still = is_still(held[0].rays, held[-2].rays, held[-1].rays)
    least_s = _BLIND_REST_S if seen_still is None else _REST_S
    if duration_s < least_s or motion.is_gap.any() or seen_still is False:
        return None
    gyro, accel = motion.midway()
    half = len(gyro) // 2
    turns = np.abs(gyro[:half].mean(axis=0) - gyro[half:].mean(axis=0))
    pulls = np.abs(accel[:half].mean(axis=0) - accel[half:].mean(axis=0))
    if turns.max() > _REST_RADPS or pulls.max() > _REST_MPS2:
        return None
    up = accel.mean(axis=0)
    sigmas = (_TILT_RAD, _FIXED, _SPEED_MPS, _GYRO_BIAS_RADPS, imu.accel_bias_sigma_mps2)
    covariance = np.diag(np.repeat(sigmas, 3) ** 2)
    covariance[2, 2] = _FIXED**2
    return FilterState(
        stamp_ns=held[0].stamp_ns,
        R=level_attitude(up / np.linalg.norm(up)),
        p=np.zeros(3),
        v=np.zeros(3),
        gyro_bias=gyro.mean(axis=0),
        accel_bias=np.zeros(3),
        covariance=covariance,
        is_standing=True,
    )


def place(state: FilterState, T_odom_base: SE3, T_imu_base: SE3) -> None:
    """Give a first state, whose place and heading are free, the place and heading of a pose of the base."""
    M = T_odom_base.R @ (state.R @ T_imu_base.R).T
    turn = so3_exp([0.0, 0.0, np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])])
    state.R, state.v = turn @ state.R, turn @ state.v
    state.p = T_odom_base.t - state.R @ T_imu_base.t
    carried = np.eye(len(state.covariance))
    for rows in (TURN, PLACE, VELOCITY):
        carried[rows, rows] = turn
    # errors turn about the origin: one that turns about the robot also moves it back
    carried[PLACE, TURN] = hat(state.p) @ turn
    state.covariance = carried @ state.covariance @ carried.T
