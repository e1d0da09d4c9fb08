"""The voxels that the last few scans saw, to tell whether a scan lies where they were."""

from __future__ import annotations

import numpy as np

from mapstream.operators.lidar.sampling import voxel_keys
from mapstream.streams.arrays import FloatArray, IntArray


class RecentVoxels:
    """Voxels of the last scans; asking costs a small part of a registration."""

    def __init__(self, voxel_size_m: float, num_scans: int = 5) -> None:
        self._voxel_size_m = voxel_size_m
        self._num_scans = num_scans
        self._scans: list[IntArray] = []
        self._seen: IntArray = np.empty(0, dtype=np.int64)

    def clear(self) -> None:
        self._scans, self._seen = [], np.empty(0, dtype=np.int64)

    def add(self, points: FloatArray) -> None:
        """Take a scan's points (N, 3) in, and let the oldest scan go."""
        keys = np.unique(voxel_keys(points, self._voxel_size_m))
        self._scans = [*self._scans[1 - self._num_scans :], keys]
        self._seen = np.unique(np.concatenate(self._scans))

    def overlap(self, points: FloatArray) -> float:
        """Return the fraction of points (N, 3) in voxels that were seen; 1 where nothing was seen yet."""
        if not self._seen.size or not len(points):
            return 1.0
        keys = voxel_keys(points, self._voxel_size_m)
        found = np.searchsorted(self._seen, keys)
        hits = self._seen[np.minimum(found, len(self._seen) - 1)] == keys
        return float(hits.mean())
