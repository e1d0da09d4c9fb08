"""Clouds of a map where they lie on Earth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mapstream.operators.gnss.geodesy import GeodeticPlane
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import invert


@dataclass(frozen=True, slots=True, kw_only=True)
class Projection:
    """From the map frame to east, north and height above the ellipsoid, or to the map's own axes."""

    crs: str  # by name: EPSG:32632; empty: the map's own axes
    wkt: str  # the same at length
    place: Callable[[FloatArray], FloatArray]  # points (N, 3) of the map frame [m], projected


def projection_of(map_: Map, crs: str = "utm") -> Projection:
    """Return where a map lies in a projection.

    The map's place on Earth is that of its first outer frame with a geodetic origin; satellite fixes give one.

    Args:
        map_: The map.
        crs: A projection by its EPSG code; `utm` is the zone of the map's origin, `map` keeps the map's own axes,
            as `utm` does where the map has no place on Earth.

    Raises:
        MapError: If a projection is asked for by code, and the map has no place on Earth.
        ConfigError: If there is no such projection.
    """
    to_lla = lla_of(map_)
    if crs == "map" or (crs == "utm" and to_lla is None):
        return Projection(crs="", wkt="", place=lambda points_map: points_map)
    if to_lla is None:
        raise MapError(
            f"a cloud in {crs} needs a map with a place on Earth, and this one never saw a satellite;"
            " write it with crs=map"
        )
    wanted = GeodeticPlane.at(crs, map_.frames.origin_lla[_placed(map_)[0]])
    return Projection(
        crs=wanted.crs,
        wkt=wanted.wkt(),
        place=lambda points_map: wanted.coordinates(to_lla(points_map)),
    )


def lla_of(map_: Map) -> Callable[[FloatArray], FloatArray] | None:
    """Return from points (N, 3) of the map frame [m] to latitude, longitude [deg] and height [m]; None without a place."""
    placed = _placed(map_)
    if not len(placed):
        return None
    frames, row = map_.frames, placed[0]
    here = GeodeticPlane.of_frame(frames.crs[row], frames.origin_lla[row])
    T_frame_map = invert(frames.T_map_frame[row])
    return lambda points_map: here.to_lla(points_map @ T_frame_map[:3, :3].T + T_frame_map[:3, 3])


def _placed(map_: Map) -> IntArray:
    """Return the outer frames (rows) whose place on Earth is known."""
    frames = map_.frames
    return np.flatnonzero(np.isfinite(frames.origin_lla).all(axis=1) & (frames.crs != ""))
