"""Depth images of a map as clouds of its vertices.

Source: maplab's `convert_all_depth_maps_to_point_clouds`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.dense.depth_views import ColorView, DepthView
from mapstream.operators.dense.sights import Reach, cloud_rows, depth_rows, views_by_vertex
from mapstream.operators.lidar.sampling import voxel_indices
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.cloud_store import CloudStore
from mapstream.recordings.maps.build import add_resources
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.store import CLOUDS
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import invert
from mapstream.streams.messages.estimates import PointCloud

_OPAQUE = 255


class DepthCloudsConfig(OperatorConfig):
    """Which pixels become points."""

    min_range_m: NonNegativeFloat = 0.3
    max_range_m: PositiveFloat = 4.0
    step_px: PositiveInt = 2
    """Every so many rows and columns."""
    voxel_size_m: PositiveFloat | None = 0.01
    """One point is left per voxel; null keeps all."""
    has_colors: bool = True
    on_existing: Literal["keep", "replace"] = "keep"
    """What to do at vertices that have a cloud."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthCloudsReport:
    """What was made."""

    num_clouds: int
    num_points: int
    num_kept: int  # vertices that had a cloud already
    left_out: dict[str, int]


def depth_clouds(
    map_: Map,
    folder: Path,
    config: DepthCloudsConfig,
    on_progress: Callable[[float], None] = lambda _: None,
) -> tuple[Map, DepthCloudsReport]:
    """Return the map with a cloud, in the base frame, at each vertex that has depth images.

    Raises:
        MapError: If no vertex has depth, or the disk refuses.
        RecordingError: If a recording is not there.
    """
    everywhere = np.arange(len(map_.vertices))
    old = cloud_rows(map_, everywhere)
    has_cloud = np.isin(everywhere, map_.resources.vertex[old])
    rows = depth_rows(map_, everywhere)
    if not len(rows):
        raise MapError(f"{folder}: no vertex of the map has a depth image; see stereo-depth")
    if config.on_existing == "keep":
        rows = rows[~has_cloud[map_.resources.vertex[rows]]]
    vertices = np.unique(map_.resources.vertex[rows])
    reach, left_out = Reach(config.min_range_m, config.max_range_m), dict[str, int]()
    views = views_by_vertex(map_, folder, rows, reach, left_out, has_colors=config.has_colors)
    names: dict[int, str] = {}
    num_points = 0
    with CloudStore(folder / CLOUDS, max_bytes=0) as store:
        for vertex, seen in views:
            cloud = _cloud(map_, vertex, seen, config)
            key = f"depth-{map_.vertices.id[vertex].tobytes().hex()}"
            store.put(key, cloud)
            names[vertex] = f"{CLOUDS}/{store.path_of(key).name}"
            num_points += len(cloud.points)
            on_progress(len(names) / len(vertices))
    is_kept = np.ones(len(map_.resources), np.bool_)
    is_kept[old[np.isin(map_.resources.vertex[old], list(names))]] = False
    changed = map_.select(resources=is_kept)
    changed = add_resources(
        changed,
        vertex_rows=np.array(list(names), np.int64),
        kind="cloud",
        paths=list(names.values()),
    )
    report = DepthCloudsReport(
        num_clouds=len(names),
        num_points=num_points,
        num_kept=int(has_cloud.sum()) if config.on_existing == "keep" else 0,
        left_out=left_out,
    )
    return changed, report


def _cloud(map_: Map, vertex: int, views: list[DepthView], config: DepthCloudsConfig) -> PointCloud:
    """Return what depth images show, around the base."""
    T_base_map = invert(map_.T_map_base(np.array([vertex]))[0])
    points, colors = [], []
    for view in views:
        of_view = view.points(config.step_px)
        points.append(of_view @ T_base_map[:3, :3].T + T_base_map[:3, 3])
        colors.append(_colors(of_view, view.color))
    joined = np.concatenate([np.empty((0, 3)), *points]).astype(np.float32)
    rgba = np.concatenate([np.empty((0, 4), np.uint8), *colors])
    if config.voxel_size_m is not None:
        chosen = voxel_indices(joined, config.voxel_size_m)
        joined, rgba = joined[chosen], rgba[chosen]
    return PointCloud(
        stamp_ns=int(map_.vertices.stamp_ns[vertex]),
        points=joined,
        colors_rgba=rgba if rgba[:, 3].any() else None,
    )


def _colors(points_map: FloatArray, color: ColorView | None) -> npt.NDArray[np.uint8]:
    """Return the colours (N, 4) of points; alpha is 0 where the camera did not see them."""
    rgba = np.zeros((len(points_map), 4), np.uint8)
    if color is None:
        return rgba
    pixels, is_in = color.pinhole.pixels(points_map, color.rgb.shape[:2])
    rgba[is_in, :3] = color.rgb[pixels[is_in, 1], pixels[is_in, 0]]
    rgba[is_in, 3] = _OPAQUE
    return rgba
