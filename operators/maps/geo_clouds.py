"""Clouds of a map where they lie on Earth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mapstream.operators.gnss.geodesy import GeodeticPlane
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
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
    is_placed = np.isfinite(map_.frames.origin_lla).all(axis=1) & (map_.frames.crs != "")
    placed = np.flatnonzero(is_placed)
    if crs == "map" or (crs == "utm" and not len(placed)):
        return Projection(crs="", wkt="", place=lambda points_map: points_map)
    if not len(placed):
        raise MapError(
            f"a cloud in {crs} needs a map with a place on Earth, and this one never saw a satellite;"
            " write it with crs=map"
        )
    origin_lla = map_.frames.origin_lla[placed[0]]
    here = GeodeticPlane.of_frame(map_.frames.crs[placed[0]], origin_lla)
    wanted = GeodeticPlane.at(crs, origin_lla)
    T_frame_map = invert(map_.frames.T_map_frame[placed[0]])

    def place(points_map: FloatArray) -> FloatArray:
        in_frame = points_map @ T_frame_map[:3, :3].T + T_frame_map[:3, 3]
        return wanted.coordinates(here.to_lla(in_frame))

    return Projection(crs=wanted.crs, wkt=wanted.wkt(), place=place)
