"""Biases of an IMU, velocities and the direction of gravity, from poses that something else measured.

The turn between poses gives the gyroscope's bias; with it, positions are linear in all the rest but the
length of gravity, which is known. Source: Qin, Li, Shen: VINS-Mono, T-RO 2018, section V-B, here with the
accelerometer's bias beside the others, and a prior on it where the motion leaves it open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.imu.parameters import ImuQuality
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import so3_exp, so3_log
from mapstream.streams.messages.sensors import ImuBatch


@dataclass(frozen=True, slots=True, eq=False)
class PoseNoise:
    """Standard deviations of the steps between poses."""

    sigma_rad: float = 0.002
    sigma_m: float = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class ImuStart:
    """What an IMU begins with."""

    gyro_bias_radps: FloatArray  # (3,)
    accel_bias_mps2: FloatArray  # (3,)
    gyro_sigma_radps: float  # of the bias, in its worst direction
    accel_sigma_mps2: float  # the same
    velocity_mps: FloatArray  # (N, 3) of the base at each pose, in their frame
    up: FloatArray  # (3,) unit vector, in the frame of the poses


@dataclass(frozen=True, slots=True, eq=False)
class _Intervals:
    """Between each two poses, in the axes of the poses' frame: (M, 3) and (M, 3, 3)."""

    duration_s: FloatArray
    speed_up: FloatArray  # by the measured force, gravity left out
    moved: FloatArray
    speed_up_by_bias: FloatArray
    moved_by_bias: FloatArray


def estimate_start(
    stamps_ns: IntArray,
    T_frame_base: FloatArray,
    imu: ImuBatch,
    parameters: ImuQuality,
    noise: PoseNoise,
) -> ImuStart:
    """Return biases, velocities and the direction of gravity.

    Args:
        stamps_ns: (N,) increasing, N >= 3, all within the samples.
        T_frame_base: (N, 4, 4) in any frame.
        imu: Samples.
        parameters: Noise of the IMU; where it sits is taken from the samples.
        noise: Of the poses' steps.

    Raises:
        EstimationError: If there are too few poses, or the samples do not cover them.
    """
    if len(stamps_ns) < 3 or stamps_ns[0] < imu.stamps_ns[0] or stamps_ns[-1] > imu.stamps_ns[-1]:
        raise EstimationError(
            f"{len(stamps_ns)} poses and samples from {imu.stamps_ns[0]} to {imu.stamps_ns[-1]} ns;"
            " at least three poses between the first and the last sample are needed"
        )
    poses = T_frame_base @ imu.T_base_sensor.matrix
    knots_ns, first, gyro, accel = _knots(stamps_ns, imu)
    gyro_bias, gyro_sigma = _gyro_bias(poses, knots_ns, first, gyro, parameters, noise)
    turns = _turns(knots_ns, first, gyro - gyro_bias)
    intervals = _integrated(poses, knots_ns, first, accel, turns)
    x, up, accel_sigma = _solved(intervals, poses, parameters, noise)
    lever = imu.T_base_sensor.R.T @ imu.T_base_sensor.t  # from the base to the IMU, in its axes
    swing = np.einsum("nij,nj->ni", poses[:, :3, :3], np.cross(gyro[first] - gyro_bias, lever))
    return ImuStart(gyro_bias, x[:3], gyro_sigma, accel_sigma, x[3:].reshape(-1, 3) - swing, up)


def _knots(stamps_ns: IntArray, imu: ImuBatch) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Return stamps of samples and poses together, which of them are poses, and the samples there."""
    inside = (imu.stamps_ns > stamps_ns[0]) & (imu.stamps_ns < stamps_ns[-1])
    knots_ns = np.union1d(imu.stamps_ns[inside], stamps_ns)
    since, at = (imu.stamps_ns - stamps_ns[0]) / 1e9, (knots_ns - stamps_ns[0]) / 1e9
    gyro, accel = (
        np.column_stack([np.interp(at, since, each[:, axis]) for axis in range(3)])
        for each in (imu.gyro_radps, imu.accel_mps2)
    )
    return knots_ns, np.searchsorted(knots_ns, stamps_ns), gyro, accel


def _turns(knots_ns: IntArray, first: IntArray, gyro: FloatArray) -> FloatArray:
    """Return the rotations (K, 3, 3) from the last pose before each knot; at a pose, from the one before it."""
    steps = so3_exp((gyro[1:] + gyro[:-1]) / 2 * (np.diff(knots_ns) / 1e9)[:, None])
    turns = np.tile(np.eye(3), (len(knots_ns), 1, 1))
    is_pose = np.zeros(len(knots_ns), bool)
    is_pose[first] = True
    for at, step in enumerate(steps):
        turns[at + 1] = step if is_pose[at] else turns[at] @ step
    return turns


def _gyro_bias(
    poses: FloatArray,
    knots_ns: IntArray,
    first: IntArray,
    gyro: FloatArray,
    parameters: ImuQuality,
    noise: PoseNoise,
) -> tuple[FloatArray, float]:
    """Return the bias (3,) by Gauss and Newton on the turns between poses, and its sigma."""
    measured = np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]
    steps_s = np.diff(knots_ns) / 1e9
    sigma = np.hypot(
        noise.sigma_rad, parameters.gyro_density * np.sqrt(np.diff(knots_ns[first]) / 1e9)
    )
    bias, information = np.zeros(3), np.eye(3)
    for _ in range(4):
        turns = _turns(knots_ns, first, gyro - bias)
        errors = so3_log(np.swapaxes(turns[first[1:]], 1, 2) @ measured)
        from_end = np.repeat(turns[first[1:]], np.diff(first), axis=0)
        shares = np.swapaxes(from_end, 1, 2) @ turns[1:] * steps_s[:, None, None]
        shares[first[1:] - 1] = np.eye(3) * steps_s[first[1:] - 1, None, None]
        by_bias = np.add.reduceat(shares, first[:-1])
        weighted, target = by_bias / sigma[:, None, None], -errors / sigma[:, None]
        information = np.einsum("nji,njk->ik", weighted, weighted)
        bias = bias + np.linalg.solve(information, np.einsum("nji,nj->i", weighted, target))
    return bias, float(1 / np.sqrt(np.linalg.eigvalsh(information)[0]))


def _integrated(
    poses: FloatArray, knots_ns: IntArray, first: IntArray, accel: FloatArray, turns: FloatArray
) -> _Intervals:
    """Return what the samples say of each interval; the force counts in the middle of each step."""
    steps_s = np.diff(knots_ns) / 1e9
    starts = turns[:-1].copy()
    starts[first[:-1]] = np.eye(3)
    half = so3_exp(so3_log(np.swapaxes(starts, 1, 2) @ turns[1:]) / 2)
    of_pose = np.repeat(poses[:-1, :3, :3], np.diff(first), axis=0)
    axes = of_pose @ starts @ half * steps_s[:, None, None]  # (K, 3, 3) of the IMU, times the step
    ends = np.repeat(knots_ns[first[1:]], np.diff(first))
    remaining_s = (ends - (knots_ns[1:] + knots_ns[:-1]) / 2) / 1e9
    forces = np.einsum("nij,nj->ni", axes, (accel[1:] + accel[:-1]) / 2)
    later = axes * remaining_s[:, None, None]
    summed = [
        np.add.reduceat(each, first[:-1])
        for each in (forces, forces * remaining_s[:, None], axes, later)
    ]
    return _Intervals(np.diff(knots_ns[first]) / 1e9, *summed)


def _solved(
    intervals: _Intervals, poses: FloatArray, parameters: ImuQuality, noise: PoseNoise
) -> tuple[FloatArray, FloatArray, float]:
    """Return the accelerometer's bias and the velocities in one vector, the direction up, and the bias' sigma."""
    up = _first_up(intervals, poses)
    A, b = _equations(intervals, poses, parameters, noise)
    N, c = A.T @ A, A.T @ b
    x: FloatArray = np.zeros(0)
    covariance: FloatArray = np.zeros((0, 0))
    for _ in range(6):
        sides = np.linalg.svd(up[None])[2][1:].T  # (3, 2) across
        free = np.zeros((len(c), len(c) - 1))  # gravity moves sideways only: its length is known
        free[:3, :2], free[3:, 2:] = -parameters.gravity_mps2 * sides, np.eye(len(c) - 3)
        known = np.zeros(len(c))
        known[:3] = -parameters.gravity_mps2 * up
        covariance = np.asarray(np.linalg.inv(free.T @ N @ free))
        x = covariance @ (free.T @ (c - N @ known))
        up = up + sides @ x[:2]
        up = up / np.linalg.norm(up)
    return x[2:], up, float(np.sqrt(np.linalg.eigvalsh(covariance[2:5, 2:5])[-1]))


def _first_up(intervals: _Intervals, poses: FloatArray) -> FloatArray:
    """Return the mean force less the change of velocity, as the poses at both ends have it."""
    p, dt = poses[:, :3, 3], intervals.duration_s
    gained = (p[-1] - p[-2]) / dt[-1] - (p[1] - p[0]) / dt[0]
    force = intervals.speed_up.sum(axis=0) - gained
    return np.asarray(force / np.linalg.norm(force))


def _equations(
    intervals: _Intervals, poses: FloatArray, parameters: ImuQuality, noise: PoseNoise
) -> tuple[FloatArray, FloatArray]:
    """Return A and b of A x = b in units of sigma; x is gravity, the accelerometer's bias, the velocities."""
    dt, num = intervals.duration_s, len(poses)
    tilted = parameters.gravity_mps2 * noise.sigma_rad  # gravity, seen by a pose that is turned
    sigma_v = np.hypot(parameters.accel_density * np.sqrt(dt), tilted * dt)
    sigma_p = np.hypot(noise.sigma_m, sigma_v * dt / 2)
    A, b = np.zeros((num - 1, 6, 6 + 3 * num)), np.zeros((num - 1, 6))
    steps = np.diff(poses[:, :3, 3], axis=0)
    for at in range(num - 1):
        v = 6 + 3 * at
        A[at, :3, :3], A[at, 3:, :3] = np.eye(3) * dt[at], np.eye(3) * dt[at] ** 2 / 2
        A[at, :3, 3:6], A[at, 3:, 3:6] = (
            -intervals.speed_up_by_bias[at],
            -intervals.moved_by_bias[at],
        )
        A[at, :3, v : v + 3], A[at, 3:, v : v + 3] = np.eye(3), np.eye(3) * dt[at]
        A[at, :3, v + 3 : v + 6] = -np.eye(3)
        b[at, :3], b[at, 3:] = -intervals.speed_up[at], steps[at] - intervals.moved[at]
        A[at, :3] /= sigma_v[at]
        b[at, :3] /= sigma_v[at]
        A[at, 3:] /= sigma_p[at]
        b[at, 3:] /= sigma_p[at]
    prior = np.zeros((3, 6 + 3 * num))
    prior[:, 3:6] = np.eye(3) / parameters.accel_bias_sigma_mps2
    return np.vstack([A.reshape(-1, 6 + 3 * num), prior]), np.append(b.ravel(), np.zeros(3))
