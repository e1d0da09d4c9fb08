"""What one colour and depth image shows of the room's shape: flat patches, and lines in space."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.operators.odometry.rgbd.edges import edges_of
from mapstream.streams.arrays import Float32Array, FloatArray

if TYPE_CHECKING:
    from scipy.spatial import KDTree

_COLUMNS = 160  # of the patches
_JUMP_M = 0.1  # within a patch: it lies on an outline
_EVERY = 4  # patches overlap
_REACH = 2  # patches around one that tell its normal
_ROUGH_AT_1_M = (
    0.006  # [m] off its plane a patch is not flat; the noise of depth grows with its square
)
_LEAST_FACING = 0.17  # cosine: a surface seen more aslant has no depth to trust
_SAME_WAY = 0.03  # of one less the cosine: normals so alike count as one direction
_MOST_DIRECTIONS = 400  # that stand for all


@dataclass(frozen=True, eq=False)
class Shape:
    """Patches and lines, in the camera's frame [m]."""

    points: FloatArray  # (N, 3)
    normals: FloatArray  # (N, 3) towards the camera
    weights: (
        FloatArray  # (N,) sum 1: each way a surface can face counts the same, however large it is
    )
    line_points: FloatArray  # (E, 3)
    directions: FloatArray  # (E, 3) along the line, of either sign

    @cached_property
    def patch_tree(self) -> KDTree:
        """Return the patches for search."""
        return _tree(self.points)

    @cached_property
    def line_tree(self) -> KDTree:
        """Return the points on lines for search."""
        return _tree(self.line_points)


def shape_of(gray: npt.NDArray[np.uint8], depth_m: Float32Array, rays: Float32Array) -> Shape:
    """Return the shape that an image shows.

    Args:
        gray: The image (H, W).
        depth_m: Along the view, (H, W); NaN: unknown.
        rays: Of the pixels, (H, W, 3) with z = 1, in the camera's frame.
    """
    patches, normals = _patches((rays * depth_m[..., None]).astype(np.float64))
    line_points, directions = edges_of(gray, depth_m, rays)
    return Shape(patches, normals, _weights(normals), line_points, directions)


def _patches(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the middles (N, 3) of flat patches and their normals (N, 3)."""
    means = _blocks(points)
    is_known = np.isfinite(means[..., 2])
    filled = np.where(is_known[..., None], means, 0)
    products = (filled[..., :, None] * filled[..., None, :]).reshape(*is_known.shape, 9)
    is_full = _around(is_known.astype(np.float64)) > 1 - 1e-6
    mean = _around(filled)[is_full]
    second = np.stack([_around(products[..., i])[is_full] for i in range(9)], axis=1)
    variances, axes = np.linalg.eigh(second.reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None])
    middles, normals = means[is_full], axes[:, :, 0]
    facing = -np.einsum("ij,ij->i", normals, middles) / np.linalg.norm(middles, axis=1)
    rough = np.sqrt(np.maximum(variances[:, 0], 0))
    good = rough < _ROUGH_AT_1_M * np.maximum(middles[:, 2], 1) ** 2
    good &= np.abs(facing) > _LEAST_FACING
    return middles[good][::_EVERY], (normals * np.sign(facing)[:, None])[good][::_EVERY]


def _around(values: FloatArray) -> FloatArray:
    """Return the means of values (h, w) or (h, w, C) around each patch; beyond the image is 0."""
    window = (2 * _REACH + 1, 2 * _REACH + 1)
    return np.asarray(cv2.boxFilter(values, -1, window, borderType=cv2.BORDER_CONSTANT))


def _blocks(points: FloatArray) -> FloatArray:
    """Return the mean point (h, w, 3) of each square of pixels; NaN where one is unknown, or behind the others."""
    height, width = points.shape[:2]
    size = max(1, width // _COLUMNS)
    rows, columns = height // size, width // size
    cut = points[: rows * size, : columns * size]
    squares = cut.reshape(rows, size, columns, size, 3)
    depths = squares[..., 2]
    is_torn = np.ptp(depths, axis=(1, 3)) > _JUMP_M
    return np.where(is_torn[..., None], np.nan, squares.mean(axis=(1, 3)))


def _weights(normals: FloatArray) -> FloatArray:
    """Return weights (N,), sum 1, one over how many normals are alike (Rusinkiewicz and Levoy, 3DIM 2001)."""
    if len(normals) == 0:
        return np.empty(0)
    some = normals[:: max(1, len(normals) // _MOST_DIRECTIONS)]
    crowd = np.exp((normals @ some.T - 1) / _SAME_WAY).mean(axis=1)
    return np.asarray(1 / crowd / (1 / crowd).sum())


def _tree(points: FloatArray) -> KDTree:
    from scipy.spatial import KDTree  # noqa: PLC0415  # heavy

    return KDTree(points)
