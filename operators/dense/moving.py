"""What moved while the map was made, or is not there any more, taken out of its clouds.

A point is not of the static world if others look through the place where it was. Each cloud is seen from other
vertices as an image of ranges: a point nearer than all that is seen around its direction was seen through,
one as far as something there is confirmed, and one behind is hidden and says nothing.
Sources: Kim, Kim: Remove, then revert, IROS 2020 (range images of one map against each other); Pomerleau et al.,
Long-term 3D map maintenance in dynamic environments, ICRA 2014 (later sessions decide what is still there).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.dense.sights import cloud_rows, lidar_place
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.cloud_store import CloudStore, read_cloud
from mapstream.recordings.maps.build import add_resources
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.store import CLOUDS
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.messages.estimates import PointCloud

_AROUND = ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1))  # a direction's cell, and those beside it
_MIN_KNOWN = 3  # of these five, for a look through them to count
_NEIGHBOURS = 12  # points around one that are asked whether they moved
_AGREEING = 0.3  # of these: looking through is rarely wrong, but edges and feet hide it
_MAX_IMAGES = 256  # in memory


class MovingConfig(OperatorConfig):
    """Options of `remove_moving`."""

    cell_deg: float = Field(default=1.0, gt=0.05, le=10.0)
    """Of the images of ranges; not finer than neighbouring beams."""
    margin_m: PositiveFloat = 0.1
    """So much farther away must be what is seen through a point."""
    margin_share: float = Field(default=0.02, ge=0.0, le=0.5)
    """The same, as a part of the distance."""
    max_views: PositiveInt = 40
    """So many other clouds look at each: those whose middles are nearest."""
    max_range_m: PositiveFloat = 60.0
    """Farther points are not judged."""
    min_votes: PositiveInt = 2
    """So many must have looked through a place."""
    share: float = Field(default=0.5, gt=0.0, le=1.0)
    """Of all that saw the place, so many must have looked through it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingReport:
    """What was taken out."""

    num_clouds: int
    num_points: int
    num_moving: int  # of them, taken out


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A cloud in the map frame."""

    points: FloatArray  # (N, 3)
    origin: FloatArray  # (3,)


def remove_moving(
    map_: Map,
    folder: Path,
    config: MovingConfig,
    on_progress: Callable[[float], None] = lambda _: None,
) -> tuple[Map, MovingReport]:
    """Return the map with clouds without points that others looked through.

    Of several missions the later ones decide: what they look through has been carried away, and what they see
    for the first time is new. The old clouds stay in the folder, so that it can be undone.

    Raises:
        MapError: If the map has no clouds, or one is missing.
    """
    rows = cloud_rows(map_, np.arange(len(map_.vertices)))
    if not len(rows):
        raise MapError(f"{folder}: the map has no clouds; see depth-clouds for depth images")
    scene = _Scene(map_, folder, rows, config)
    paths, num_points, num_moving = [], 0, 0
    with CloudStore(folder / CLOUDS, max_bytes=0) as store:
        for number, row in enumerate(rows.tolist()):
            cloud = scene.cloud(number)
            is_moving = scene.is_moving(number, cloud)
            key = f"static-{map_.vertices.id[map_.resources.vertex[row]].tobytes().hex()}"
            store.put(key, _kept(cloud, ~is_moving))
            paths.append(f"{CLOUDS}/{store.path_of(key).name}")
            num_points, num_moving = num_points + len(is_moving), num_moving + int(is_moving.sum())
            on_progress((number + 1) / len(rows))
    is_other = np.ones(len(map_.resources), np.bool_)
    is_other[rows] = False
    vertices = map_.resources.vertex[rows]
    cleaned = add_resources(
        map_.select(resources=is_other), vertex_rows=vertices, kind="cloud", paths=paths
    )
    return cleaned, MovingReport(num_clouds=len(rows), num_points=num_points, num_moving=num_moving)


class _Scene:
    """All clouds of a map, and how each looks from another one's place."""

    def __init__(self, map_: Map, folder: Path, rows: IntArray, config: MovingConfig) -> None:
        self._map, self._folder, self._rows, self._config = map_, folder, rows, config
        self._missions = map_.vertices.mission[map_.resources.vertex[rows]]
        self._places = {m: lidar_place(map_, m) for m in np.unique(self._missions).tolist()}
        begins = {m: int(map_.vertices.stamp_ns[map_.vertices_of(m)].min()) for m in self._places}
        self._begin_ns = np.array([begins[m] for m in self._missions.tolist()])
        self._middles = np.array(
            [self._view(n, self.cloud(n)).points.mean(axis=0) for n in range(len(rows))]
        )
        self._ranges = lru_cache(maxsize=_MAX_IMAGES)(self._ranges_from)

    def cloud(self, number: int) -> PointCloud:
        """Return a cloud as it is stored."""
        return read_cloud(self._folder / self._map.resources.path[self._rows[number]])

    def is_moving(self, number: int, cloud: PointCloud) -> BoolArray:
        """Return which points (N,) of a cloud others looked through."""
        view, config = self._view(number, cloud), self._config
        away_m = np.linalg.norm(view.points - view.origin, axis=1)
        is_moving = np.zeros(len(view.points), np.bool_)
        for mission in self._judges(number):
            others = np.flatnonzero(self._missions == mission)
            others = others[others != number]
            apart_m = np.linalg.norm(self._middles[others] - self._middles[number], axis=1)
            nearest = others[np.argsort(apart_m, kind="stable")[: config.max_views]]
            through, seen = np.zeros((2, len(view.points)), np.int64)
            for other in nearest.tolist():
                is_through, is_seen = self._votes(view.points, other)
                through += is_through
                seen += is_seen
            is_moving |= (through >= config.min_votes) & (
                through >= config.share * (through + seen)
            )
        is_moving &= away_m <= config.max_range_m
        return _agreed(view.points, is_moving)

    def _judges(self, number: int) -> list[int]:
        """Return the missions that say what is still there: its own, and later ones in the same frame."""
        own, is_known = self._missions[number], self._map.missions.is_base_frame_known
        is_later = (self._begin_ns > self._begin_ns[number]) & is_known[self._missions]
        is_judge = (self._missions == own) | (is_later & is_known[own])
        judges: list[int] = np.unique(self._missions[is_judge]).tolist()
        return judges

    def _view(self, number: int, cloud: PointCloud) -> _View:
        row = self._rows[number]
        vertex = int(self._map.resources.vertex[row])
        T = self._map.T_map_base(np.array([vertex]))[0]
        place = self._places[int(self._missions[number])]
        points = cloud.points.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        return _View(points, T[:3, :3] @ place + T[:3, 3])

    def _ranges_from(self, number: int) -> tuple[Float32Array, FloatArray]:
        """Return the nearest range by elevation and azimuth from a cloud's own place; infinite: nothing seen."""
        view = self._view(number, self.cloud(number))
        cells, range_m = self._cells(view.points - view.origin)
        nearest_m = np.full(self._shape(), np.inf, np.float32)
        np.minimum.at(nearest_m, cells, range_m.astype(np.float32))
        return nearest_m, view.origin

    def _votes(self, points: FloatArray, other: int) -> tuple[BoolArray, BoolArray]:
        """Return which points another place looked through, and which it saw where they are."""
        nearest_m, origin = self._ranges(other)
        (elevation, azimuth), range_m = self._cells(points - origin)
        margin_m = np.maximum(self._config.margin_m, self._config.margin_share * range_m)
        height, width = nearest_m.shape
        num_known, is_near = np.zeros(len(points), np.int64), np.zeros(len(points), np.bool_)
        is_seen = np.zeros(len(points), np.bool_)
        for de, da in _AROUND:
            around_m = nearest_m[np.clip(elevation + de, 0, height - 1), (azimuth + da) % width]
            num_known += np.isfinite(around_m)
            is_near |= around_m <= range_m + margin_m
            is_seen |= np.abs(around_m - range_m) <= margin_m
        return (num_known >= _MIN_KNOWN) & ~is_near, is_seen

    def _shape(self) -> tuple[int, int]:
        return int(180 / self._config.cell_deg) + 1, round(360 / self._config.cell_deg)

    def _cells(self, rays: FloatArray) -> tuple[tuple[IntArray, IntArray], FloatArray]:
        """Return the cells of rays (N, 3) by elevation and azimuth, and their lengths (N,) [m]."""
        height, width = self._shape()
        range_m = np.linalg.norm(rays, axis=1)
        step = np.radians(self._config.cell_deg)
        elevation = np.arcsin(rays[:, 2] / np.maximum(range_m, 1e-9)) + np.pi / 2
        azimuth = np.arctan2(rays[:, 1], rays[:, 0]) + np.pi
        rows = np.minimum((elevation / step).astype(np.int64), height - 1)
        return (rows, (azimuth / step).astype(np.int64) % width), range_m


def _agreed(points: FloatArray, is_moving: BoolArray) -> BoolArray:
    """Return what the points around each say: a foot goes with its leg, and a lone edge of a table stays."""
    if not is_moving.any() or len(points) <= _NEIGHBOURS:
        return is_moving
    from scipy.spatial import cKDTree  # noqa: PLC0415  # scipy takes its time

    near = cKDTree(points).query(points, _NEIGHBOURS)[1]
    agreed: BoolArray = is_moving[near].mean(axis=1) > _AGREEING
    return agreed


def _kept(cloud: PointCloud, keep: BoolArray) -> PointCloud:
    return PointCloud(
        stamp_ns=cloud.stamp_ns,
        points=cloud.points[keep],
        intensity=None if cloud.intensity is None else cloud.intensity[keep],
        colors_rgba=None if cloud.colors_rgba is None else cloud.colors_rgba[keep],
        record=cloud.record,
    )
