"""Where things are: landmarks, planes and regions by what they are called.

Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section V (semantic mapping, labels of places).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapstream.operators.maps.naming import distance_m, things, words_of
from mapstream.operators.maps.regions import Region, regions_at, regions_of
from mapstream.operators.maps.words import matches
from mapstream.recordings.maps.hulls import hull_of
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.object_payload import object_payload
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import quat_xyzw_from_rotation


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Thing:
    """A landmark or a region, where it is in the map frame."""

    kind: str  # of a landmark: object, plane, pose ...; of a region: room, place ...
    name: str  # that people gave it; empty: none
    label: str  # its class
    text: str  # what is written on it
    id: str  # of a landmark, 32 hex digits; of a region empty
    position: FloatArray  # (3,) [m]
    quat_xyzw: FloatArray | None  # (4,) where it has an orientation
    extent_m: FloatArray | None  # (3,) along its axes; NaN where it has no end
    regions: tuple[str, ...]  # that it lies in, the smallest first
    num_observations: int
    distance_m: float | None = None  # from where was asked


def where(map_: Map, text: str, near: FloatArray | None = None) -> list[Thing]:
    """Return what is called so, those seen most often first; or the nearest first, if a point (3,) is given."""
    rows = [row for row in things(map_).tolist() if matches(text, words_of(map_, row))]
    regions = regions_of(map_)
    found = described(map_, rows, near)
    found += [
        _region(region, regions, near)
        for region in regions
        if matches(text, (region.name, region.kind))
    ]
    if near is not None:
        return sorted(found, key=lambda each: (each.distance_m or 0.0, each.id, each.name))
    return sorted(found, key=lambda each: (-each.num_observations, each.label, each.name, each.id))


def described(map_: Map, rows: Sequence[int], near: FloatArray | None = None) -> list[Thing]:
    """Return what is known of landmarks (rows), in their order; with how far they are from a point (3,)."""
    regions, counts = regions_of(map_), observation_counts(map_)
    return [_landmark(map_, row, regions, counts, near) for row in rows]


def observation_counts(map_: Map) -> IntArray:
    """Return how often each landmark (L,) was seen: as observations, and by measurements."""
    seen = np.concatenate([map_.observations.landmark, map_.edges.landmark_a])
    return np.bincount(seen[seen >= 0], minlength=len(map_.landmarks))


def extent_of(map_: Map, row: int) -> FloatArray | None:
    """Return the size of a landmark along its axes (3,) [m]; a plane's is that of its outline."""
    hull = hull_of(map_.landmarks.payload[row])
    if len(hull) > 1:
        return np.append(np.ptp(hull, axis=0), 0.0)
    extent_m = object_payload(map_.landmarks, row).get("extent_m")
    if not isinstance(extent_m, list) or np.shape(extent_m) != (3,):
        return None
    return np.array(extent_m, np.float64)


def _landmark(
    map_: Map, row: int, regions: Sequence[Region], counts: IntArray, near: FloatArray | None
) -> Thing:
    known, table = object_payload(map_.landmarks, row), map_.landmarks
    T_map_landmark = map_.T_map_landmark(np.array([row]))[0]
    position = T_map_landmark[:3, 3]
    hull = hull_of(table.payload[row])
    if len(hull):  # the middle of what is known of a plane
        middle = (hull.min(axis=0) + hull.max(axis=0)) / 2
        position = T_map_landmark[:3, :2] @ middle + position
    is_turned = bool(np.isfinite(table.quat_base_xyzw[row]).all())
    return Thing(
        kind=table.kind[row],
        name=str(known.get("name", "")),
        label=table.label[row],
        text=str(known.get("text", "")),
        id=bytes(table.id[row]).hex(),
        position=position,
        quat_xyzw=quat_xyzw_from_rotation(T_map_landmark[:3, :3]) if is_turned else None,
        extent_m=extent_of(map_, row),
        regions=tuple(region.name for region in regions_at(regions, position)),
        num_observations=int(counts[row]),
        distance_m=None if near is None else distance_m(map_, row, near),
    )


def _region(region: Region, regions: Sequence[Region], near: FloatArray | None) -> Thing:
    around = [r.name for r in regions_at(regions, region.center) if r.area_m2 > region.area_m2]
    away_m = None
    if near is not None:
        away_m = 0.0 if region.holds(near) else float(np.linalg.norm(region.center - near))
    return Thing(
        kind=region.kind,
        name=region.name,
        label="",
        text="",
        id="",
        position=region.center,
        quat_xyzw=None,
        extent_m=region.extent_m if len(region.corners) > 1 else None,
        regions=tuple(around),
        num_observations=0,
        distance_m=away_m,
    )
