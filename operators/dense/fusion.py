"""A map's depth images or clouds, fused where its poses of now put them.

Source: maplab's `tsdf` command; Oleynikova et al., Voxblox, IROS 2017.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.dense.cloud_integration import (
    CloudIntegration,
    CloudView,
    integrate_cloud,
)
from mapstream.operators.dense.depth_integration import DepthIntegration, integrate_depth
from mapstream.operators.dense.depth_views import DepthView
from mapstream.operators.dense.sights import Reach, cloud_rows, cloud_views, depth_rows, depth_views
from mapstream.operators.dense.volume import TsdfVolume
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import MapError

Progress = Callable[[float], None]


class FusionConfig(OperatorConfig):
    """What is fused, and how."""

    voxel_size_m: PositiveFloat = 0.05
    truncation_voxels: PositiveFloat = Field(default=4.0, ge=2.0)
    """So many voxels around a surface tell how far it is."""
    source: Literal["auto", "depth", "cloud"] = "auto"
    """Depth images or clouds of the map's vertices; auto: depth where the map has any."""
    min_range_m: NonNegativeFloat = 0.3
    max_range_m: PositiveFloat | None = None
    """Farther measurements are left out; by default 4 m of depth images, 80 m of clouds."""
    has_colors: bool = True
    """Take colours from images, or from coloured clouds."""
    carves: bool = True
    """What one sees through is free, though something seemed to be there at another time."""
    uses_normals: bool = True
    """Of clouds: measure along the surface's normal, not along the ray."""
    with_unanchored: bool = False
    """Also missions whose place in the map is a guess."""
    max_bytes: PositiveInt = 4_000_000_000
    """Of the volume in memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionReport:
    """What was fused."""

    source: str
    num_views: int
    num_blocks: int
    num_bytes: int
    left_out: dict[str, int] = field(default_factory=dict)  # views by the reason


def fuse(
    map_: Map,
    folder: Path,
    config: FusionConfig,
    *,
    fills_free_space: bool = False,
    on_progress: Progress = lambda _: None,
) -> tuple[TsdfVolume, FusionReport]:
    """Return the volume of all that a map's vertices saw, and what was done.

    Args:
        map_: The map; only its newest poses count, wherever odometry saw things.
        folder: Its folder, with clouds and depth images; recordings lie where the map says.
        config: See there.
        fills_free_space: Voxels also where nothing is, as distance fields need them.
        on_progress: Told which part is done.

    Raises:
        MapError: If there is nothing to fuse, or it needs more memory than is allowed.
        RecordingError: If a recording is not there.
    """
    vertices = _vertices(map_, config)
    source, rows = _chosen(map_, vertices, config, folder)
    default_m = 4.0 if source == "depth" else 80.0
    reach = Reach(config.min_range_m, config.max_range_m or default_m)
    volume = TsdfVolume(
        config.voxel_size_m,
        config.voxel_size_m * config.truncation_voxels,
        config.max_bytes,
        has_colors=config.has_colors,
    )
    left_out: dict[str, int] = {}
    views: Iterator[DepthView | CloudView]
    if source == "depth":
        views = depth_views(map_, folder, rows, reach, left_out, has_colors=config.has_colors)
    else:
        views = cloud_views(map_, folder, rows, reach, has_colors=config.has_colors)
    of_depth = DepthIntegration(carves=config.carves, fills_free_space=fills_free_space)
    of_cloud = CloudIntegration(
        carves=config.carves, fills_free_space=fills_free_space, uses_normals=config.uses_normals
    )
    num_views, has_seen_colors = 0, False
    for view in views:
        if isinstance(view, DepthView):
            has_seen_colors |= view.color is not None
            integrate_depth(volume, view, of_depth)
        else:
            has_seen_colors |= view.rgb is not None
            integrate_cloud(volume, view, of_cloud)
        num_views += 1
        on_progress(min(1.0, num_views / len(rows)))
    if not has_seen_colors:
        volume.drop_colors()
    report = FusionReport(
        source=source,
        num_views=num_views,
        num_blocks=len(volume),
        num_bytes=volume.num_bytes,
        left_out=left_out,
    )
    return volume, report


def _vertices(map_: Map, config: FusionConfig) -> IntArray:
    """Return the vertices whose place counts."""
    is_known = map_.missions.is_base_frame_known[map_.vertices.mission] | config.with_unanchored
    rows = np.flatnonzero(is_known)
    if not len(rows):
        raise MapError(
            "the map has no vertices of missions whose place is known; anchor them, or set with_unanchored=true"
        )
    return rows


def _chosen(
    map_: Map, vertices: IntArray, config: FusionConfig, folder: Path
) -> tuple[Literal["depth", "cloud"], IntArray]:
    """Return what is fused, and the resources that hold it."""
    if config.source != "cloud":
        rows = depth_rows(map_, vertices)
        if len(rows):
            return "depth", rows
    if config.source != "depth":
        rows = cloud_rows(map_, vertices)
        if len(rows):
            return "cloud", rows
    what = {"auto": "neither depth images nor clouds", "depth": "no depth images"}
    raise MapError(
        f"{folder}: the map has {what.get(config.source, 'no clouds')} of missions whose place is known; connect depth "
        "to `keyframes`, compute it from stereo (stereo-depth), or connect submaps to the map_store"
    )
