"""The upright box of a thing, from points on it that many views saw.

Points that few views agree on are of what lies behind or beside it. The box of least area around the others tells
the orientation; its sides are between percentiles, so that single points do not count.
Source of the box: Freeman and Shapira, Determining the minimum-area encasing rectangle, Communications of the ACM 1975
(`cv2.minAreaRect`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

_CELLS = 12  # along the longer side of a thing, in which views are counted
_LEAST_CELL_M = 0.02
_MIN_POINTS = 50
_MIN_VIEWS = 2  # that agree on a cell
_MIN_SHARE = 0.1  # of the views that saw most of a cell
_TRIMMED = 1.0  # percent of the points beyond each side


@dataclass(frozen=True, slots=True, eq=False)
class UprightBox:
    """A box that stands upright in the map."""

    center: FloatArray  # (3,) [m]
    yaw_rad: float  # of its longer horizontal side, from x of the map
    extent_m: FloatArray  # (3,) longer and shorter horizontal side, height
    points: FloatArray  # (K, 3) that it is around [m]


def upright_box(points: FloatArray, views: IntArray) -> UprightBox | None:
    """Return the box around what views agree on; None if that is too little.

    Args:
        points: Shape (N, 3), in the map [m].
        views: Shape (N,), the number of the view that saw each point.
    """
    if len(points) < _MIN_POINTS:
        return None
    kept = points[_agreed(points, views)]
    if len(kept) < _MIN_POINTS:
        return None
    flat = kept[:, :2]
    middle = np.median(flat, axis=0)
    yaw_rad = 0.0
    for _ in range(3):  # what sticks out after one turn does not decide the next
        turned = (flat - middle) @ _turn(yaw_rad)
        low, high = np.percentile(turned, [_TRIMMED, 100 - _TRIMMED], axis=0)
        inside = ((turned >= low) & (turned <= high)).all(axis=1)
        yaw_rad = np.deg2rad(cv2.minAreaRect((flat - middle)[inside].astype(np.float32))[2])
    return _between(kept, middle, yaw_rad)


def _between(points: FloatArray, middle: FloatArray, yaw_rad: float) -> UprightBox:
    turned = np.column_stack([(points[:, :2] - middle) @ _turn(yaw_rad), points[:, 2]])
    low, high = np.percentile(turned, [_TRIMMED, 100 - _TRIMMED], axis=0)
    extent_m, center = high - low, (low + high) / 2
    center[:2] = _turn(yaw_rad) @ center[:2] + middle
    if extent_m[1] > extent_m[0]:
        yaw_rad, extent_m = yaw_rad + np.pi / 2, extent_m[[1, 0, 2]]
    yaw_rad = (yaw_rad + np.pi / 2) % np.pi - np.pi / 2  # its two ends are alike
    return UprightBox(center, float(yaw_rad), extent_m, points)


def _turn(yaw_rad: float) -> FloatArray:
    """Return the axes (2, 2) of a frame turned so, as columns."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s], [s, c]])


def _agreed(points: FloatArray, views: IntArray) -> BoolArray:
    """Return which points (N,) lie where several views saw some, in one piece with most of them."""
    from scipy import ndimage  # noqa: PLC0415  # takes long to import

    low, high = np.percentile(points, [5, 95], axis=0)
    cell_m = max(float((high - low).max()) / _CELLS, _LEAST_CELL_M)
    reach = 2 * (high - low) + cell_m  # farther away nothing is of it
    near = (np.abs(points - (low + high) / 2) <= reach).all(axis=1)
    cells = np.floor((points - points[near].min(axis=0)) / cell_m).astype(np.int64)
    shape = cells[near].max(axis=0) + 1
    counts = np.zeros(shape, np.int64)
    for view in np.unique(views).tolist():
        seen = np.zeros(shape, np.bool_)
        seen[tuple(cells[near & (views == view)].T)] = True
        counts += ndimage.binary_dilation(seen, np.ones((3, 3, 3)))
    needed = max(_MIN_VIEWS, _MIN_SHARE * counts.max()) if len(np.unique(views)) > 2 else 1
    filled = np.zeros(shape, np.bool_)
    filled[tuple(cells[near].T)] = True
    pieces, num = ndimage.label(filled & (counts >= needed), np.ones((3, 3, 3)))
    if not num:
        return np.zeros(len(points), np.bool_)
    own = np.zeros(len(points), np.int64)
    own[near] = pieces[tuple(cells[near].T)]
    largest = np.bincount(own, minlength=num + 1)[1:].argmax() + 1
    agreed: BoolArray = own == largest
    return agreed
