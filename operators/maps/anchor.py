"""Where missions lie in the map, set by hand."""

from __future__ import annotations

from dataclasses import replace

from mapstream.recordings.maps.build import anchored
from mapstream.recordings.maps.model import Map
from mapstream.streams.geometry import SE3


def anchor(map_: Map, mission_row: int, T_map_mission: SE3 | None = None) -> Map:
    """Return the map with a base frame that is known: the given one, or the guess that there is."""
    return anchored(map_, mission_row, T_map_mission or map_.missions.T_map_mission_of(mission_row))


def release(map_: Map, mission_row: int) -> Map:
    """Return the map with a base frame that is only a guess, which solvers may move."""
    is_known = map_.missions.is_base_frame_known.copy()
    is_known[mission_row] = False
    return replace(map_, missions=replace(map_.missions, is_base_frame_known=is_known))
