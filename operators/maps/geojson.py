"""Objects, planes and regions of a map as GeoJSON (RFC 7946), for geographic programs.

Where satellites gave the map a place on Earth, coordinates are longitude, latitude and height; else they are metres
of the map frame, and the file says so.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mapstream.operators.maps.geo_clouds import lla_of
from mapstream.operators.maps.naming import things
from mapstream.operators.maps.regions import regions_of
from mapstream.operators.maps.where import described
from mapstream.recordings.maps.hulls import hull_of
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import MapError, RecordingError

_Place = Callable[[FloatArray], FloatArray]  # of points (N, 3) of the map frame


def write_geojson(map_: Map, path: Path, *, in_map_frame: bool = False) -> dict[str, int]:
    """Write objects as points, planes and regions as polygons; return how many of each.

    Args:
        map_: The map.
        path: The file.
        in_map_frame: Keep the map's own axes, though the map has a place on Earth.

    Raises:
        MapError: If there are none.
        RecordingError: If the file cannot be written.
    """
    to_lla = None if in_map_frame else lla_of(map_)
    document: dict[str, Any] = {"type": "FeatureCollection"}
    if to_lla is None:
        document["frame"] = "map"  # x, y, z in metres

    def place(points: FloatArray) -> FloatArray:
        return points if to_lla is None else to_lla(points)[:, [1, 0, 2]]

    landmarks, regions = list(_landmarks(map_, place)), list(_regions(map_, place))
    if not landmarks and not regions:
        raise MapError(f"{path}: the map has no objects, planes or regions to write")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(document | {"features": landmarks + regions}, indent=1) + "\n")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error}") from error
    return {"landmarks": len(landmarks), "regions": len(regions)}


def _landmarks(map_: Map, place: _Place) -> Iterator[dict[str, Any]]:
    rows = things(map_)
    for row, thing in zip(rows.tolist(), described(map_, rows.tolist()), strict=True):
        hull = hull_of(map_.landmarks.payload[row])
        T = map_.T_map_landmark(np.array([row]))[0]
        corners = hull @ T[:3, :2].T + T[:3, 3]
        known: dict[str, Any] = {
            "kind": thing.kind,
            "class": thing.label,
            "name": thing.name,
            "text": thing.text,
            "region": next(iter(thing.regions), ""),
        }
        if thing.extent_m is not None:
            known["extent_m"] = thing.extent_m.round(4).tolist()
        properties = {key: value for key, value in known.items() if value != ""}
        properties["num_observations"] = thing.num_observations
        shape = corners if len(corners) > 2 else thing.position[None]
        yield _feature(thing.id, place(shape), properties)


def _regions(map_: Map, place: _Place) -> Iterator[dict[str, Any]]:
    for region in regions_of(map_):
        properties: dict[str, Any] = {"kind": region.kind, "name": region.name}
        if np.isfinite(region.height_m):
            properties["height_m"] = region.height_m
        yield _feature(f"{region.kind} {region.name}", place(region.corners), properties)


def _feature(name: str, corners: FloatArray, properties: dict[str, Any]) -> dict[str, Any]:
    """Return a point of one corner, a polygon of several (K, 3), counterclockwise as the RFC has it."""
    if len(corners) == 1:
        geometry: dict[str, Any] = {"type": "Point", "coordinates": corners[0].tolist()}
    else:
        x, y = (corners[:, :2] - corners[0, :2]).T
        if x @ np.roll(y, -1) - y @ np.roll(x, -1) < 0:
            corners = corners[::-1]
        ring = [*corners.tolist(), corners[0].tolist()]
        geometry = {"type": "Polygon", "coordinates": [ring]}
    return {"type": "Feature", "id": name, "geometry": geometry, "properties": properties}
