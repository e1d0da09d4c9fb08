"""One cloud of all keyframe clouds, where the optimised poses put them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pydantic import PositiveFloat, PositiveInt

from mapstream.operators.lidar.sampling import voxel_keys
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.cloud_store import read_cloud
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import Float32Array, FloatArray, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.messages.estimates import PointCloud

_MAX_VOXELS = 2**20  # from the origin; farther ones would share a key
_NUM_SUMS = 9  # x, y, z, intensity, points, red, green, blue, points with a colour
_MIN_MERGE = 1_000_000  # points that are collected before voxels are merged


class AggregateConfig(OperatorConfig):
    voxel_size_m: PositiveFloat = 0.1
    """One point is left per voxel, the mean of those in it."""
    with_unanchored: bool = False
    """Also missions whose place in the map is a guess."""
    max_voxels: PositiveInt = 50_000_000
    """A cloud of more gets voxels of twice the size, again and again, until it has no more: 100 bytes each."""


def aggregate_cloud(map_: Map, folder: Path, config: AggregateConfig) -> PointCloud:
    """Return the points of all stored clouds in the map frame, one per voxel.

    Args:
        map_: The map; only its newest poses count, wherever odometry saw the clouds.
        folder: The map's folder, with its clouds.
        config: See there.

    Raises:
        MapError: If the map has no clouds, one is missing, or the map is too large for the voxels.
    """
    resources = map_.resources
    rows = np.flatnonzero((resources.kind == "cloud") & (resources.topic == ""))
    mission = map_.vertices.mission[resources.vertex[rows]]
    chosen = rows[map_.missions.is_base_frame_known[mission] | config.with_unanchored]
    if not len(chosen):
        reason = "of missions whose place is known" if len(rows) else "at all"
        raise MapError(f"{folder}: there are no clouds {reason}; connect submaps to the map_store")
    voxels = _Voxels(config.voxel_size_m, config.max_voxels)
    poses = map_.T_map_base(resources.vertex[chosen])
    for row, T_map_base in zip(chosen.tolist(), poses, strict=True):
        cloud = read_cloud(folder / resources.path[row])
        points_map = cloud.points.astype(np.float64) @ T_map_base[:3, :3].T + T_map_base[:3, 3]
        voxels.add(points_map, cloud.intensity, cloud.colors_rgba)
    points, intensity, colors = voxels.means()
    return PointCloud(
        stamp_ns=map_.stamp_ns,
        points=points.astype(np.float32),
        intensity=None if np.isnan(intensity).all() else intensity.astype(np.float32),
        colors_rgba=colors if colors[:, 3].any() else None,
    )


@dataclass(slots=True)
class _Voxels:
    """Sums of the points in each voxel; memory grows with the voxels, not with the points."""

    size_m: float
    max_voxels: int
    keys: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))  # (V,) increasing
    sums: FloatArray = field(default_factory=lambda: np.empty((0, _NUM_SUMS)))
    _pending: list[FloatArray] = field(default_factory=list)
    _num_pending: int = 0

    def add(
        self,
        points: FloatArray,
        intensity: Float32Array | None,
        colors_rgba: npt.NDArray[np.uint8] | None,
    ) -> None:
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
        reach_m = _MAX_VOXELS * self.size_m
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
