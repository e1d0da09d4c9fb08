"""Lines in space: edges of a gray image, each at the depth of the nearer of its two sides.

The nearer side is what has the edge; the farther one is only hidden by it.
Source: Choi, Trevor and Christensen, RGB-D Edge Detection and Edge-Based Registration, IROS 2013.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import Float32Array, FloatArray, IntArray

_BLUR_PX = 1.2
_GRADIENTS = (40, 100)  # Canny's thresholds
_REACH_PER_WIDTH = 1 / 160  # around an edge, where depth of both its sides is found
_LEAST_KNOWN = 0.25  # of the pixels there
_JUMP_M = 0.12  # between the sides of a silhouette
_THICK_M = 0.045  # of the nearer side
_NUM_NEIGHBORS = 12  # that tell the direction
_BEND = 0.15  # of the variance along a line, at most, across it
_GAP_M = 0.06  # between neighbours, at most
_EVERY = 2  # edge points are dense


def edges_of(
    gray: npt.NDArray[np.uint8], depth_m: Float32Array, rays: Float32Array
) -> tuple[FloatArray, FloatArray]:
    """Return points (E, 3) on lines, and the lines' directions (E, 3).

    Args:
        gray: The image (H, W).
        depth_m: Along the view, (H, W); NaN: unknown.
        rays: Of the pixels, (H, W, 3) with z = 1, in the camera's frame.
    """
    from scipy.spatial import KDTree  # noqa: PLC0415  # heavy

    smooth = cv2.GaussianBlur(gray, (5, 5), _BLUR_PX)
    px = np.argwhere(cv2.Canny(smooth, *_GRADIENTS, L2gradient=True) > 0)
    depths, px = _depths(px, depth_m)
    found = (rays[px[:, 0], px[:, 1]] * depths[:, None]).astype(np.float64)
    if len(px) < _NUM_NEIGHBORS:
        return np.empty((0, 3)), np.empty((0, 3))
    around = found[KDTree(px).query(px, k=_NUM_NEIGHBORS)[1]]  # (E, K, 3)
    middle = around.mean(axis=1)
    spread = around - middle[:, None]
    variances, axes = np.linalg.eigh(np.swapaxes(spread, 1, 2) @ spread)
    is_line = variances[:, 1] < _BEND * variances[:, 2]
    is_line &= np.linalg.norm(around - found[:, None], axis=2).max(axis=1) < _GAP_M
    return middle[is_line][::_EVERY], axes[is_line][::_EVERY, :, 2]


def _depths(px: IntArray, depth_m: Float32Array) -> tuple[Float32Array, IntArray]:
    """Return the depths (E,) of the pixels (E, 2), row and column, where they are known; and those pixels."""
    reach = max(1, round(depth_m.shape[1] * _REACH_PER_WIDTH))
    px = px[((px >= reach) & (px < np.array(depth_m.shape) - reach)).all(axis=1)]
    steps = np.arange(-reach, reach + 1, max(1, reach // 2))
    rows, columns = px[:, 0, None, None] + steps[:, None], px[:, 1, None, None] + steps
    depths = depth_m[rows, columns].reshape(len(px), len(steps) ** 2)
    is_known = np.isfinite(depths)
    enough = is_known.mean(axis=1) >= _LEAST_KNOWN
    px, depths, is_known = px[enough], depths[enough], is_known[enough]
    nearest = np.where(is_known, depths, np.inf).min(axis=1, initial=np.inf)
    farthest = np.where(is_known, depths, 0).max(axis=1, initial=0)
    is_silhouette = farthest - nearest > _JUMP_M
    is_used = is_known & (~is_silhouette[:, None] | (depths < nearest[:, None] + _THICK_M))
    return np.where(is_used, depths, 0).sum(axis=1) / np.maximum(is_used.sum(axis=1), 1), px
