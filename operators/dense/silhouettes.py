"""Where things end in a depth image: behind their rims nothing is known of them.

Without care the unseen back of a thing, next to the free space beside it, becomes a surface that hangs behind its rim
like a curtain. A surface that one sees at a grazing angle has large differences of depth as well, but the inverse depth
of a plane is an affine function of the pixel, so it does not bend.
"""

from __future__ import annotations

import numpy as np

from mapstream.operators.dense.depth_views import DepthView
from mapstream.streams.arrays import BoolArray, Float32Array

_RIM_VOXELS = 2.0  # so wide is a rim
_SAMPLED = 8  # every so many rows and columns tell how far things are
_BEHIND_VOXELS = 1.5  # so far behind a rim a thing is taken to reach


def least_distances_m(view: DepthView, voxel_size_m: float, truncation_m: float) -> Float32Array:
    """Return, for each pixel (H, W), how far behind its surface something is known [m], negative.

    That is the truncation, and at rims of things hardly more than a voxel.
    """
    inverse = np.reciprocal(view.depth_m)  # NaN where nothing was seen
    some = inverse[::_SAMPLED, ::_SAMPLED]
    middle = float(np.nanmedian(some)) if np.isfinite(some).any() else 0.0
    focal_px = float(view.pinhole.camera_matrix[0, 0])
    span = max(1, round(_RIM_VOXELS * voxel_size_m * focal_px * middle))
    span = min(span, max(1, min(inverse.shape) // 4))
    bend = np.float32(truncation_m) * inverse * inverse  # a step in depth as long as the truncation
    is_rim = np.zeros(inverse.shape, np.bool_)
    _mark_convex(is_rim, inverse, bend, span)
    _mark_convex(is_rim.T, inverse.T, bend.T, span)
    near = np.float32(-_BEHIND_VOXELS * voxel_size_m)
    return np.where(is_rim, near, np.float32(-truncation_m))


def _mark_convex(is_rim: BoolArray, inverse: Float32Array, bend: Float32Array, span: int) -> None:
    """Mark the pixels that stand out from those a span before and after in their column, or from one of them."""
    inside = slice(span, -span)
    outside = 2 * inverse[inside] - inverse[: -2 * span] - inverse[2 * span :]
    is_rim[inside] |= outside > bend[inside]  # false where one is NaN
