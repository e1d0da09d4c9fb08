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
_MIN_MERGE = 1_000_000  # points that are collected before voxels are merged


@dataclass(slots=True)
class Voxels:
    """Sums of the points in each voxel; memory grows with the voxels, not with the points."""

    size_m: float
    max_voxels: int  # of more, voxels of twice the size are made
    keys: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (V,) increasing
    sums: FloatArray = field(default_factory=lambda: np.empty((0, _NUM_SUMS)))
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
        rows = np.zeros((len(points), _NUM_SUMS))
        rows[:, :3], rows[:, 4] = points, 1.0
        rows[:, 3] = np.nan if intensity is None else intensity
        if colors_rgba is not None:
            is_seen = colors_rgba[:, 3] > 0
            rows[is_seen, 5:8], rows[is_seen, 8] = colors_rgba[is_seen, :3], 1.0
        self._pending.append(rows)
        self._num_pending += len(points)
        if self._num_pending >= max(_MIN_MERGE, len(self.keys)):  # as much as a merge sorts anyway
            self._merge()

    def _merge(self) -> None:
        rows = np.concatenate([np.empty((0, _NUM_SUMS)), *self._pending])
        reach_m = _FARTHEST * self.size_m
        if np.abs(rows[:, :3]).max(initial=0) >= reach_m:
            raise MapError(
                f"points lie beyond {reach_m:.0f} m of the map's origin; use larger voxels"
            )
        keys = np.concatenate([self.keys, voxel_keys(rows[:, :3], self.size_m)])
        self._pending, self._num_pending = [], 0
        self._sum_up(keys, np.concatenate([self.sums, rows]))
        while len(self.keys) > self.max_voxels:
            self.size_m *= 2
            middles = self.sums[:, :3] / self.sums[:, 4:5]
            self._sum_up(voxel_keys(middles, self.size_m), self.sums)

    def _sum_up(self, keys: IntArray, rows: FloatArray) -> None:
        self.keys, voxel = np.unique(keys, return_inverse=True)
        columns = [np.bincount(voxel, column, minlength=len(self.keys)) for column in rows.T]
        self.sums = np.column_stack(columns)

    def means(self) -> tuple[FloatArray, FloatArray, npt.NDArray[np.uint8]]:
        """Return the mean points (V, 3), intensities (V,) and colours (V, 4), in the order of the voxels."""
        self._merge()
        means = self.sums[:, :4] / self.sums[:, 4:5]
        num_seen = self.sums[:, 8:]
        colors = np.round(self.sums[:, 5:8] / np.maximum(num_seen, 1.0))
        rgba = np.hstack([colors, np.where(num_seen > 0, 255.0, 0.0)]).astype(np.uint8)
        return means[:, :3], means[:, 3], rgba
