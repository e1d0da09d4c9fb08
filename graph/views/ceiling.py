"""Indoors a map is a closed box: without its lid one sees where the robot drove."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray

_HEADROOM_M = 1.0  # above the base; what is lower is no ceiling
_LID_M = 0.6  # thickness of what is taken off: ceilings are rough and have beams
_SHARE = 0.08  # of all points in it: 13 to 17 % in a corridor, about 1 % in a street


def is_below_ceiling(points: Float32Array, path: FloatArray) -> BoolArray:
    """Return which points (N,) lie below the ceiling; all of them where there is none.

    Args:
        points: Shape (N, 3) [m], z up.
        path: Positions of the base (K, 3), in the same frame; heights count from the nearest.
    """
    everything = np.ones(len(points), bool)
    if not len(points):
        return everything
    height = points[:, 2] - path[cKDTree(path[:, :2]).query(points[:, :2])[1], 2]
    lid_m = np.percentile(height, 99) - _LID_M
    if lid_m < _HEADROOM_M or np.mean(height >= lid_m) < _SHARE:
        return everything
    below: BoolArray = height < lid_m
    return below
