"""One point per voxel: the mean of all points in it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from mapstream.operators.lidar.sampling import voxel_keys
from mapstream.streams.arrays import Float32Array, FloatArray, IntArray
from mapstream.streams.errors import MapError

_FARTHEST = 2**20  # voxels from the origin; farther ones would share a key
_NUM_SUMS = 9  # x, y, z, intensity, points, red, green, blue, points with a colour
_MIN_MERGE, _MAX_MERGE = 500_000, 2_000_000  # points that wait: as many as a merge sorts anyway


@dataclass(slots=True)
class Voxels:
    """Sums of the points in each voxel; memory grows with the voxels, not with the points."""

    size_m: float
    max_voxels: int  # of more, voxels of twice the size are made
    keys: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (V,) increasing
    sums: FloatArray = field(default_factory=lambda: np.empty((_NUM_SUMS, 0)))  # (9, V)
    _pending: list[FloatArray] = field(default_factory=list)
    _num_pending: int = 0

    def add(
        self,
        points: FloatArray,
        intensity: Float32Array | None = None,
        colors_rgba: npt.NDArray[np.uint8] | None = None,
    ) -> None:
        """Add points (N, 3) [m], intensities (N,) and colours (N, 4).

        Raises:
            MapError: If a point is too far from zero for voxels of this size.
        """
        columns = np.zeros((_NUM_SUMS, len(points)))
        columns[:3], columns[4] = points.T, 1.0
        columns[3] = np.nan if intensity is None else intensity
        if colors_rgba is not None:
            columns[8] = colors_rgba[:, 3] > 0
            columns[5:8] = colors_rgba[:, :3].T * columns[8]
        self._pending.append(columns)
        self._num_pending += len(points)
        if self._num_pending >= np.clip(len(self.keys), _MIN_MERGE, _MAX_MERGE):
            self._merge()

    def _merge(self) -> None:
        columns = np.concatenate([np.empty((_NUM_SUMS, 0)), *self._pending], axis=1)
        self._pending, self._num_pending = [], 0
        reach_m = _FARTHEST * self.size_m
        if np.abs(columns[:3]).max(initial=0) >= reach_m:
            raise MapError(
                f"points lie beyond {reach_m:.0f} m of the map's origin; use larger voxels"
            )
        keys = np.concatenate([self.keys, voxel_keys(columns[:3].T, self.size_m)])
        self._sum_up(keys, np.concatenate([self.sums, columns], axis=1))
        while len(self.keys) > self.max_voxels:
            self.size_m *= 2
            middles = self.sums[:3] / self.sums[4]
            self._sum_up(voxel_keys(middles.T, self.size_m), self.sums)

    def _sum_up(self, keys: IntArray, columns: FloatArray) -> None:
        self.keys, voxel = np.unique(keys, return_inverse=True)
        self.sums = np.stack([np.bincount(voxel, column, len(self.keys)) for column in columns])

    def means(self) -> tuple[FloatArray, FloatArray, npt.NDArray[np.uint8]]:
        """Return the mean points (V, 3), intensities (V,) and colours (V, 4), in the order of the voxels."""
        self._merge()
        means = self.sums[:4] / self.sums[4]
        num_seen = self.sums[8]
        colors = np.round(self.sums[5:8] / np.maximum(num_seen, 1.0))
        rgba = np.vstack([colors, np.where(num_seen > 0, 255.0, 0.0)]).astype(np.uint8)
        return means[:3].T, means[3], rgba.T
