"""Indoors a map is a closed box: without its lid one sees where the robot drove."""

from __future__ import annotations

import numpy as np

from mapstream.streams.messages.sensors import Float32Array

_HEADROOM_M = 1.0  # above the base; what is lower is no ceiling
_LID_M = 0.6  # thickness of what is taken off: ceilings are rough and have beams
_SHARE = 0.08  # of all points in it: 13 to 17 % in a corridor, about 1 % in a street


def without_ceiling(points: Float32Array, base_height_m: float) -> Float32Array:
    """Return the points (N, 3), z up, below the ceiling; all points where there is none."""
    if not len(points):
        return points
    lid_m = np.percentile(points[:, 2], 99) - _LID_M
    is_below = points[:, 2] < lid_m
    if lid_m < base_height_m + _HEADROOM_M or np.mean(~is_below) < _SHARE:
        return points
    below: Float32Array = points[is_below]
    return below
