"""One cloud of all keyframe clouds, where the optimised poses put them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from mapstream.operators.maps.voxels import Voxels
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.cloud_store import read_cloud
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.messages.estimates import PointCloud


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
    voxels = Voxels(config.voxel_size_m, config.max_voxels)
    for points_map, cloud in placed_clouds(map_, folder, with_unanchored=config.with_unanchored):
        voxels.add(points_map, cloud.intensity, cloud.colors_rgba)
    points, intensity, colors = voxels.means()
    return PointCloud(
        stamp_ns=map_.stamp_ns,
        points=points.astype(np.float32),
        intensity=None if np.isnan(intensity).all() else intensity.astype(np.float32),
        colors_rgba=colors if colors[:, 3].any() else None,
    )


def placed_clouds(
    map_: Map, folder: Path, *, with_unanchored: bool = False
) -> Iterator[tuple[FloatArray, PointCloud]]:
    """Yield the points (N, 3) of each stored cloud in the map frame [m], and the cloud as it is stored.

    Raises:
        MapError: If the map has no clouds, or one is missing.
    """
    rows = placed_cloud_rows(map_, folder, with_unanchored=with_unanchored)
    poses = map_.T_map_base(map_.resources.vertex[rows])
    for row, T_map_base in zip(rows.tolist(), poses, strict=True):
        cloud = read_cloud(folder / map_.resources.path[row])
        yield cloud.points.astype(np.float64) @ T_map_base[:3, :3].T + T_map_base[:3, 3], cloud


def placed_cloud_rows(map_: Map, folder: Path, *, with_unanchored: bool = False) -> IntArray:
    """Return the resources that are clouds of missions whose place is known, or of all missions.

    Raises:
        MapError: If there are none.
    """
    resources = map_.resources
    rows = np.flatnonzero((resources.kind == "cloud") & (resources.topic == ""))
    mission = map_.vertices.mission[resources.vertex[rows]]
    chosen = rows[map_.missions.is_base_frame_known[mission] | with_unanchored]
    if not len(chosen):
        reason = "of missions whose place is known" if len(rows) else "at all"
        raise MapError(f"{folder}: there are no clouds {reason}; connect submaps to the map_store")
    return chosen
