"""What a planar scan says of surfaces: its points, and the line through each point's neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.laser.planar import rotation
from mapstream.streams.arrays import FloatArray

_NUM_NEIGHBOURS = 8  # beams on either side that may help to fit a line
_REACH_M = 0.15  # of the neighbours, where beams are dense
_REACH_SPACINGS = 3.5  # where they are not: so many spacings of beams
_NUM_IN_CLOUD = 12  # neighbours of a point where beams have no order
_REACH_IN_CLOUD_M = 0.3
_MIN_POINTS = 4  # on a line
_FLATNESS = 0.25  # points scatter across a line by no more than this part of their scatter along it


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Points in the plane, each with the unit normal of the line that it lies on."""

    points: FloatArray  # (N, 2) [m]
    normals: FloatArray  # (N, 2) towards the laser; nan where there is no line
    has_sides: bool = True  # False: normals may as well point away from the laser

    def __len__(self) -> int:
        return len(self.points)

    def moved(self, pose: FloatArray) -> Surface:
        """Return it in another frame, by the pose (3,) of this one in that."""
        R = rotation(pose[2])
        return Surface(self.points @ R.T + pose[:2], self.normals @ R.T, self.has_sides)

    def within(self, radius_m: float) -> Surface:
        """Return the points around the origin."""
        keep = np.linalg.norm(self.points, axis=1) <= radius_m
        return Surface(self.points[keep], self.normals[keep], self.has_sides)

    def lined(self) -> Surface:
        """Return the points that lie on lines."""
        keep = np.isfinite(self.normals[:, 0])
        return Surface(self.points[keep], self.normals[keep], self.has_sides)


def surface_of(points: FloatArray, eye: FloatArray) -> Surface:
    """Return the surface that a scan saw.

    A line is fitted to the neighbours of each point that are near it, on both sides of it or on one.

    Args:
        points: (N, 2) in the order of the beams.
        eye: (2,) where the laser was.
    """
    if not len(points):
        return Surface(points, points)
    padding = np.full((_NUM_NEIGHBOURS, 2), np.nan)
    padded = np.concatenate([padding, points, padding])
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _NUM_NEIGHBOURS + 1, axis=0)
    apart = windows - points[:, :, None]  # (N, 2, W)
    squares = np.einsum("ncw,ncw->nw", apart, apart)
    neighbours = squares[:, [_NUM_NEIGHBOURS - 1, _NUM_NEIGHBOURS + 1]]
    spacing = np.where(np.isfinite(neighbours), neighbours, np.inf).min(axis=1) ** 0.5
    reach = np.clip(_REACH_SPACINGS * spacing, _REACH_M, 4 * _REACH_M)
    near = squares <= reach[:, None] ** 2  # nan compares false
    apart = np.where(near[:, None, :], apart, 0.0)
    num = near.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = apart.sum(axis=2) / num[:, None]
        second = np.einsum("ncw,ndw->ncd", apart, apart) / num[:, None, None]
    normals, scatter = _normals(second - mean[:, :, None] * mean[:, None, :])
    normals *= np.where(np.einsum("nc,nc->n", normals, eye - points) < 0, -1.0, 1.0)[:, None]
    with np.errstate(invalid="ignore"):
        is_line = (num >= _MIN_POINTS) & (scatter[:, 0] <= _FLATNESS**2 * scatter[:, 1])
    normals = np.where(is_line[:, None], normals, np.nan)
    return Surface(points, normals)


def surface_of_cloud(points: FloatArray) -> Surface:
    """Return the surface that points (N, 2) in any order lie on; nobody knows from which side they were seen."""
    from scipy.spatial import KDTree  # noqa: PLC0415  # slow to import

    num = min(_NUM_IN_CLOUD, len(points))
    near_m, at = KDTree(points).query(points, k=num, distance_upper_bound=_REACH_IN_CLOUD_M)
    near = np.isfinite(near_m)
    apart = np.where(near[..., None], points[np.where(near, at, 0)] - points[:, None], 0.0)
    count = near.sum(axis=1)[:, None]
    mean = apart.sum(axis=1) / count
    second = np.einsum("nwc,nwd->ncd", apart, apart) / count[:, :, None]
    normals, scatter = _normals(second - mean[:, :, None] * mean[:, None, :])
    is_line = (count[:, 0] >= _MIN_POINTS) & (scatter[:, 0] <= _FLATNESS**2 * scatter[:, 1])
    return Surface(points, np.where(is_line[:, None], normals, np.nan), has_sides=False)


def _normals(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the directions (N, 2) of least scatter of (N, 2, 2), and the scatter (N, 2), least first."""
    a, b, c = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    along = np.arctan2(2 * b, a - c) / 2
    half, root = (a + c) / 2, np.hypot((a - c) / 2, b)
    normals = np.stack([-np.sin(along), np.cos(along)], axis=-1)
    return normals, np.stack([half - root, half + root], axis=-1)
