"""Places and rooms with names: outlines in the map that move with it, and what lies in them.

Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section V (semantic mapping, labels of places).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from pydantic import Field, PositiveFloat, field_validator

from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.semantic_tables import Regions
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import invert

_LEAST_AREA_M2 = 1e-6


class RegionConfig(OperatorConfig):
    """A room or a place, in the map frame."""

    name: str = Field(min_length=1)
    kind: str = Field(default="room", min_length=1)
    polygon: tuple[tuple[float, float], ...] = Field(min_length=1)
    """Corners x, y [m] in order, one way round or the other; a single one is a place."""
    z_m: float | None = None
    """Height of the outline; without it that of the nearest vertex."""
    height_m: PositiveFloat | None = None
    """How far it reaches up from its outline; without it, it has neither floor nor ceiling."""

    @field_validator("polygon")
    @classmethod
    def _is_simple(
        cls, polygon: tuple[tuple[float, float], ...]
    ) -> tuple[tuple[float, float], ...]:
        corners = np.array(polygon)
        if not np.isfinite(corners).all():
            raise ValueError("a corner is not finite")
        if len(corners) == 2:
            raise ValueError("two corners are neither a place (one) nor an outline (three or more)")
        if len(corners) > 2 and (abs(_area(corners)) < _LEAST_AREA_M2 or _crosses_itself(corners)):
            raise ValueError("its outline has no area, or crosses itself")
        return polygon


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Region:
    """A region where the map has it now."""

    name: str
    kind: str
    corners: FloatArray  # (K, 3) in the map frame [m]; one: a place
    height_m: float  # NaN: no floor and no ceiling

    @property
    def center(self) -> FloatArray:
        """The middle of what it covers (3,), in the map frame."""
        middle: FloatArray = self.corners.mean(axis=0)
        if len(self.corners) > 2:
            middle[:2] = _centroid(self.corners[:, :2])
        if np.isfinite(self.height_m):
            middle[2] += self.height_m / 2
        return middle

    @property
    def area_m2(self) -> float:
        return abs(_area(self.corners[:, :2]))

    @property
    def extent_m(self) -> FloatArray:
        """Its size along x, y and z of the map (3,) [m]; NaN upwards if it has no ceiling."""
        return np.append(np.ptp(self.corners[:, :2], axis=0), self.height_m)

    def holds(self, p_map: FloatArray) -> bool:
        """Return whether a point (3,) lies in it; a place without outline holds none."""
        if len(self.corners) < 3 or not _is_inside(self.corners[:, :2], p_map[:2]):
            return False
        above_m = float(p_map[2] - self.corners[:, 2].mean())
        return not np.isfinite(self.height_m) or 0 <= above_m <= self.height_m


def regions_of(map_: Map) -> list[Region]:
    """Return the regions of a map, by name."""
    table = map_.regions
    T_map_base = map_.T_map_base(table.vertex)
    found = [
        Region(
            name=table.name[row],
            kind=table.kind[row],
            corners=outline_corners(table.outline[row]) @ T[:3, :3].T + T[:3, 3],
            height_m=float(table.height_m[row]),
        )
        for row, T in enumerate(T_map_base)
    ]
    return sorted(found, key=lambda region: (region.name, region.kind))


def regions_at(regions: Sequence[Region], p_map: FloatArray) -> list[Region]:
    """Return the regions that a point (3,) of the map frame lies in, the smallest first."""
    return sorted((each for each in regions if each.holds(p_map)), key=lambda each: each.area_m2)


def add_region(map_: Map, config: RegionConfig) -> tuple[Map, Region]:
    """Return the map with one more region, fixed to the nearest vertex.

    Raises:
        MapError: If there is one of its name and kind, or the map has no vertices.
    """
    if any(r.name == config.name and r.kind == config.kind for r in regions_of(map_)):
        raise MapError(f"there is a {config.kind} {config.name!r} already; remove it first")
    if not len(map_.vertices):
        raise MapError("the map has no vertices, so that a region has nothing to be fixed to")
    T_map_base = map_.T_map_base(np.arange(len(map_.vertices)))
    xy = np.array(config.polygon)
    middle = _centroid(xy) if len(xy) > 2 else xy[0]
    away = np.linalg.norm(T_map_base[:, :2, 3] - middle, axis=1)
    if config.z_m is not None:
        away = np.hypot(away, T_map_base[:, 2, 3] - config.z_m)
    vertex = int(away.argmin())
    z_m = float(T_map_base[vertex, 2, 3]) if config.z_m is None else config.z_m
    T_base_map = invert(T_map_base[vertex])
    corners = np.column_stack([xy, np.full(len(xy), z_m)])
    added = Regions(
        id=id_array([derived_id("region", config.kind, config.name)]),
        name=np.array([config.name], dtype=object),
        kind=np.array([config.kind], dtype=object),
        vertex=np.array([vertex]),
        outline=outlines([corners @ T_base_map[:3, :3].T + T_base_map[:3, 3]]),
        height_m=np.array([np.nan if config.height_m is None else config.height_m]),
    )
    made = replace(map_, regions=concatenate([map_.regions, added]))
    return made, next(r for r in regions_of(made) if (r.name, r.kind) == (config.name, config.kind))


def remove_region(map_: Map, name: str, kind: str | None = None) -> tuple[Map, int]:
    """Return the map without the regions of a name, and of a kind if one is given, and how many they were.

    Raises:
        MapError: If there is none.
    """
    goes = map_.regions.name == name
    if kind is not None:
        goes &= map_.regions.kind == kind
    if not goes.any():
        known = ", ".join(f"{r.kind} {r.name!r}" for r in regions_of(map_)) or "no regions"
        raise MapError(f"no region {name!r}; the map has {known}")
    return map_.select(regions=~goes), int(goes.sum())


def outlines(corners: Sequence[FloatArray]) -> np.ndarray[tuple[int], np.dtype[np.object_]]:
    """Return outlines (K, 3) as the column of the table."""
    blocks = np.empty(len(corners), dtype=object)
    blocks[:] = [np.asarray(each, "<f8").tobytes() for each in corners]
    return blocks


def outline_corners(outline: bytes) -> FloatArray:
    """Return the corners (K, 3) of an outline of the table, in the base of its vertex."""
    return np.frombuffer(outline, "<f8").reshape(-1, 3)


def _area(xy: FloatArray) -> float:
    """Return the area of a polygon (K, 2), positive if it goes round counterclockwise."""
    x, y = (xy - xy[0]).T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _centroid(xy: FloatArray) -> FloatArray:
    """Return the middle (2,) of the area of a polygon (K, 2)."""
    (x, y), (x_next, y_next) = (xy - xy[0]).T, np.roll(xy - xy[0], -1, axis=0).T
    cross = x * y_next - x_next * y
    offset = np.array([(x + x_next) @ cross, (y + y_next) @ cross]) / (3 * cross.sum())
    middle: FloatArray = xy[0] + offset
    return middle


def _is_inside(xy: FloatArray, point: FloatArray) -> bool:
    """Return whether a point (2,) is inside a polygon (K, 2): a ray from it crosses an odd number of sides."""
    x, y = point
    (x_0, y_0), (x_1, y_1) = xy.T, np.roll(xy, -1, axis=0).T
    spans = (y_0 > y) != (y_1 > y)
    rise = np.where(spans, y_1 - y_0, 1.0)
    crossings = spans & (x < x_0 + (y - y_0) / rise * (x_1 - x_0))
    return bool(crossings.sum() % 2)


def _crosses_itself(xy: FloatArray) -> bool:
    """Return whether two sides of a polygon (K, 2) that are not neighbours meet."""
    sides = list(zip(xy, np.roll(xy, -1, axis=0), strict=True))
    return any(
        _meet(*sides[i], *sides[j])
        for i, j in combinations(range(len(sides)), 2)
        if j - i not in (1, len(sides) - 1)
    )


def _meet(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> bool:
    def side(p: FloatArray, q: FloatArray, r: FloatArray) -> float:
        return float(np.sign((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])))

    return side(a, b, c) != side(a, b, d) and side(c, d, a) != side(c, d, b)
