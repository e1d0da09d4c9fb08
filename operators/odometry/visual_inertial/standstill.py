"""When the robot stands: how that is seen, and what it tells the filter.

Images that do not change over half a second say so, if rate and force stay the same as well; without images a
robot that stood goes on standing as long as the IMU does not object. Then velocity is zero, the
gyroscope shows its bias, the accelerometer gravity and its bias, and the pose is the one before.
Source: Geneva et al., OpenVINS, ICRA 2020 (zero velocity update).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.odometry.visual.rays import Rays
from mapstream.operators.odometry.visual_inertial.propagation import Motion
from mapstream.operators.odometry.visual_inertial.state import (
    ACCEL_BIAS,
    GYRO_BIAS,
    NUM_INERTIAL,
    POSE,
    TURN,
    VELOCITY,
    FilterState,
    update,
)
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import hat, invert, se3_log

_SPAN_NS = 400_000_000
_MOST_SIGMAS = 0.6  # of a keypoint, by which the median one may have moved over the span
_MOST_GROWTH = 1.2  # from one image to the next, and over the span: noise does not grow
_MOST_NOISE_SIGMAS = 2.5
_LEAST_COMMON = 6  # tracks that must be in both images
_REST_RADPS, _REST_MPS2 = 0.02, 0.25  # by which the last of the span may differ from the others
_SIGMA_MPS, _SIGMA_M, _SIGMA_RAD = 0.005, 0.0005, 0.0005


class Standstill:
    """Judges n-frames in their order.

    Args:
        is_standing: Whether the robot is known to stand at the first one.
    """

    def __init__(self, *, is_standing: bool) -> None:
        self._seen: deque[tuple[int, Rays, FloatArray]] = (
            deque()
        )  # stamp, rays, mean of the samples
        self.is_standing = is_standing

    def judge(self, stamp_ns: int, rays: Rays, motion: Motion) -> bool:
        """Return whether the robot has stood still for a while; `motion` is that since the last n-frame."""
        mean = np.concatenate([each.mean(axis=0) for each in motion.midway()])
        self._seen.append((stamp_ns, rays, mean))
        while len(self._seen) > 2 and self._seen[1][0] <= stamp_ns - _SPAN_NS:
            self._seen.popleft()
        start_ns, before, _ = self._seen[0]
        is_long = self.is_standing or stamp_ns - start_ns >= 0.9 * _SPAN_NS
        seen_still = is_still(before, self._seen[-2][1] if len(self._seen) > 1 else before, rays)
        seems_still = self.is_standing if seen_still is None else seen_still
        self.is_standing = bool(
            is_long and seems_still and self._is_calm() and not motion.is_gap.any()
        )
        return self.is_standing

    def _is_calm(self) -> bool:
        means = np.array([mean for _, _, mean in self._seen][1:])
        if len(means) < 2:
            return self.is_standing
        change = np.abs(
            means[-1] - means[:-1].mean(axis=0)
        )  # the last may be the first of a motion
        return bool((change[:3] < _REST_RADPS).all() and (change[3:] < _REST_MPS2).all())


def is_still(first: Rays, before: Rays, now: Rays) -> bool | None:
    """Return whether tracks have moved no more since the first image than since the one before; None if none can tell."""
    whole, step = displacement(first, now), displacement(before, now)
    if whole is None or step is None:
        return None
    return whole < max(_MOST_SIGMAS, min(_MOST_NOISE_SIGMAS, _MOST_GROWTH * step))


def displacement(before: Rays, now: Rays) -> float | None:
    """Return by how many sigmas the median track has moved in the image; None if too few are in both."""
    keys_before, keys_now = (_names(rays) for rays in (before, now))
    _, i, j = np.intersect1d(keys_before, keys_now, return_indices=True)
    if len(i) < _LEAST_COMMON:
        return None
    moved = np.linalg.norm(np.einsum("nij,nj->ni", before.weights[i], now.rays[j]), axis=1)
    return float(np.median(moved))


def _names(rays: Rays) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return rays.keys ^ (rays.cameras.astype(np.int64) << 56)


def stand(state: FilterState, motion: Motion, imu: ImuQuality, R_first: FloatArray) -> None:
    """Tell the filter that the robot stood during `motion`, at the pose of the last clone.

    A tilt and a bias of the accelerometer that make up for each other cannot be told apart at rest. So that
    the filter does not think it can, derivatives are taken at one attitude all the time.

    Args:
        state: At the end of `motion`; changed.
        motion: Samples.
        imu: Its noise.
        R_first: (3, 3) attitude when the robot came to rest.
    """
    gyro, accel = (each.mean(axis=0) for each in motion.midway())
    root_s = np.sqrt(motion.steps_s.sum())
    up = np.array([0.0, 0.0, imu.gravity_mps2])
    H, r = np.zeros((9, NUM_INERTIAL)), np.zeros(9)
    H[0:3, VELOCITY], r[0:3] = np.eye(3), -state.v
    H[3:6, GYRO_BIAS], r[3:6] = np.eye(3), gyro - state.gyro_bias
    H[6:9, ACCEL_BIAS], r[6:9] = np.eye(3), accel - state.accel_bias - state.R.T @ up
    H[6:9, TURN] = R_first.T @ hat(up)
    sigmas = np.repeat([_SIGMA_MPS, imu.gyro_density / root_s, imu.accel_density / root_s], 3)
    H, r = H / sigmas[:, None], r / sigmas
    update(state, np.arange(NUM_INERTIAL), H, r)
    if len(state.clone_ids):
        _hold(state)


def _hold(state: FilterState) -> None:
    """Tell the filter that the pose of now is that of the last clone."""
    before = np.eye(4)
    before[:3, :3], before[:3, 3] = state.clone_R[-1], state.clone_p[-1]
    now = state.T_odom_imu
    local = now.inverse().adjoint() / np.repeat([_SIGMA_RAD, _SIGMA_M], 3)[:, None]
    H = np.hstack([local, -local])
    r = local @ se3_log(before @ invert(now.matrix))
    columns = np.r_[POSE, state.clone_columns(-1)]
    update(state, columns, H, r)
