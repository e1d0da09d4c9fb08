"""Indoors a map is a closed box: without its lid one sees where the robot drove."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mapstream.streams.messages.sensors import Float32Array, FloatArray

_REACH_M = 0.6  # beside the path; where the robot went there is nothing above it but a ceiling
_HEADROOM_M = 0.4  # above the base
_COVERED = 0.5  # of the path: less is a tree, a wire, a bridge
_SLACK_M = 0.3  # ceilings are rough


def without_ceiling(points: Float32Array, path: FloatArray) -> Float32Array:
    """Return the points below the ceiling, all points where there is none over the path.

    Args:
        points: Shape (N, 3) [m], z up.
        path: Positions of the base (K, 3), in the same frame.
    """
    if not len(points):
        return points
    distance, row = cKDTree(path[:, :2]).query(points[:, :2])
    height = points[:, 2] - path[row, 2]
    is_overhead = (distance < _REACH_M) & (height > _HEADROOM_M)
    if len(np.unique(row[is_overhead])) <= _COVERED * len(path):
        return points
    below: Float32Array = points[height < np.median(height[is_overhead]) - _SLACK_M]
    return below
