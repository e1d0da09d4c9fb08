"""Areas of boxes in images, and what two of them share.

Coordinates come first, x_min, y_min, x_max, y_max, and all else broadcasts: numpy's sums and products over short
last axes would take most of the time where many boxes are compared.
"""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import FloatArray


def area_px2(box: FloatArray) -> FloatArray:
    """Return the areas (...) of boxes (4 or more, ...)."""
    area: FloatArray = (box[2] - box[0]) * (box[3] - box[1])
    return area


def shared_px2(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the areas (...) that boxes (4 or more, ...) have in common; 0 where they lie apart."""
    width = np.minimum(a[2], b[2]) - np.maximum(a[0], b[0])
    height = np.minimum(a[3], b[3]) - np.maximum(a[1], b[1])
    shared: FloatArray = np.maximum(width, 0.0) * np.maximum(height, 0.0)
    return shared


def intersection_over_union(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return what boxes (4 or more, ...) both cover as a share (...) of what either does."""
    shared = shared_px2(a, b)
    share: FloatArray = shared / (area_px2(a) + area_px2(b) - shared)
    return share
