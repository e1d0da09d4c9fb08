"""The surroundings as points, one a voxel, and the planes that they make around any place.

The point of a voxel is the mean of the first that fell into it, so that noise does not stay in the map.
Source: Xu et al., FAST-LIO2: Fast Direct LiDAR-inertial Odometry, T-RO 2022, section V.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from small_gicp import KdTree, PointCloud

from mapstream.operators.lidar.sampling import voxel_keys
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

_NUM_NEIGHBOURS = 6
_MOST_MEANED = 8  # points of a voxel; then its mean stays, and with it the map
_FLAT = 0.15  # a plane's points are so much farther spread in either direction than across ...
_WIDE = 0.05  # ... and no line


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """What lies around N places."""

    centres: FloatArray  # (N, 3) [m]
    normals: FloatArray  # (N, 3)
    is_flat: BoolArray  # (N,) whether there is a plane at all


class PointMap:
    """Points around the sensor; those that it left behind are forgotten."""

    def __init__(self, voxel_size_m: float, radius_m: float) -> None:
        """Make an empty map.

        Args:
            voxel_size_m: One point is kept in each voxel.
            radius_m: Points farther away from the sensor are forgotten.
        """
        self._voxel_size_m = voxel_size_m
        self._radius_m = radius_m
        self._kept_from: FloatArray = np.full(
            3, np.inf
        )  # where the sensor was when points were forgotten
        self._keys: IntArray = np.empty(0, np.int64)  # (M,) increasing
        self._sums: FloatArray = np.empty((0, 3))
        self._counts: IntArray = np.empty(0, np.int64)
        self._tree: KdTree | None = None
        self.points: FloatArray = np.empty((0, 3))  # (M, 3) [m]

    @property
    def is_empty(self) -> bool:
        return len(self._keys) == 0

    def clear(self) -> None:
        self._keys, self._counts = self._keys[:0], self._counts[:0]
        self._sums, self.points, self._tree = self._sums[:0], self.points[:0], None

    def add(self, points: FloatArray, centre: FloatArray) -> None:
        """Take points (N, 3) in, seen from a centre (3,), both in the map's frame."""
        keys, voxel = np.unique(voxel_keys(points, self._voxel_size_m), return_inverse=True)
        counts = np.bincount(voxel)
        sums = np.column_stack([np.bincount(voxel, points[:, axis]) for axis in range(3)])
        at = np.searchsorted(self._keys, keys)
        known = np.append(self._keys, -1)[at] == keys
        grows = at[known][self._counts[at[known]] < _MOST_MEANED]
        more = known.copy()
        more[known] = self._counts[at[known]] < _MOST_MEANED
        self._counts[grows] += counts[more]
        self._sums[grows] += sums[more]
        fresh = ~known
        self._keys = np.insert(self._keys, at[fresh], keys[fresh])
        self._counts = np.insert(self._counts, at[fresh], counts[fresh])
        self._sums = np.insert(self._sums, at[fresh], sums[fresh], axis=0)
        if not np.linalg.norm(centre - self._kept_from) < self._radius_m / 4:
            self._forget(centre)
        self.points = self._sums / self._counts[:, None]
        self._tree = (
            KdTree(PointCloud(self.points), 1) if len(self.points) >= _NUM_NEIGHBOURS else None
        )

    def planes(self, places: npt.NDArray[np.floating], far_m: float = 0.0) -> Planes:
        """Return the plane through the map's points that lie next to each place (N, 3), or `far_m` farther."""
        if self._tree is None:
            nothing = np.zeros((len(places), 3))
            return Planes(nothing, nothing, np.zeros(len(places), bool))
        found, _ = self._tree.batch_knn_search(places, _NUM_NEIGHBOURS)
        near = self.points[np.asarray(found, dtype=np.int64)]  # (N, K, 3)
        centres = near.mean(axis=1)
        spread = near - centres[:, None]
        extents, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))
        reach = far_m + 2 * self._voxel_size_m + np.sqrt(extents[:, 2])
        is_near = np.linalg.norm(centres - places, axis=1) < reach
        is_flat = (extents[:, 0] < _FLAT**2 * extents[:, 1]) & (
            extents[:, 1] > _WIDE * extents[:, 2]
        )
        return Planes(centres, axes[:, :, 0], is_near & is_flat)

    def _forget(self, centre: FloatArray) -> None:
        points = self._sums / self._counts[:, None]
        kept = np.linalg.norm(points - centre, axis=1) < self._radius_m
        self._keys, self._counts, self._sums = (
            self._keys[kept],
            self._counts[kept],
            self._sums[kept],
        )
        self._kept_from = centre
