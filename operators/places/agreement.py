"""Poses that several measurements claim: which of them agree, and their mean."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.geometry import invert, se3_exp, se3_log, so3_log

_MEANS = 10  # steps towards the mean of poses


def agreement(
    poses: FloatArray, max_turn_rad: float, max_shift_m: float, points: FloatArray | None = None
) -> BoolArray:
    """Return which poses (N, N) agree with which.

    Args:
        poses: (N, 4, 4) of one frame, as N measurements claim it.
        max_turn_rad: Between two that agree.
        max_shift_m: The same of the place where each measured; that way a small turn does no harm far away.
        points: (N, 3) in that frame, where each measured; without, its origin.
    """
    turned = np.linalg.norm(so3_log((invert(poses)[:, None] @ poses)[:, :, :3, :3]), axis=2)
    at = np.zeros((len(poses), 3)) if points is None else points
    there = np.einsum("nij,mj->nmi", poses[:, :3, :3], at) + poses[:, None, :3, 3]
    own = there[np.arange(len(poses)), np.arange(len(poses))]
    shifted = np.linalg.norm(there - own, axis=2)
    agree: BoolArray = (turned <= max_turn_rad) & (shifted <= max_shift_m)
    return agree


def largest_agreement(
    poses: FloatArray, max_turn_rad: float, max_shift_m: float, points: FloatArray | None = None
) -> BoolArray:
    """Return which poses (N,) agree with that one with which most do; every one is tried."""
    if not len(poses):
        return np.zeros(0, bool)
    agree = agreement(poses, max_turn_rad, max_shift_m, points)
    best: BoolArray = agree[int(np.argmax(agree.sum(axis=1)))]
    return best


def mean_pose(poses: FloatArray) -> FloatArray:
    """Return the pose from which these (N, 4, 4) are off by nothing on the whole."""
    mean: FloatArray = poses[0]
    for _ in range(_MEANS):
        mean = mean @ se3_exp(se3_log(invert(mean) @ poses).mean(axis=0))
    return mean
