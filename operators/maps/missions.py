"""Missions by what people call them, and vertices of missions by time."""

from __future__ import annotations

import numpy as np

from mapstream.recordings.maps.model import Map
from mapstream.streams.errors import MapError
from mapstream.streams.messages.sensors import IntArray


def find_mission(map_: Map, text: str) -> int:
    """Return the row of the mission whose id begins with these digits, or that has this name.

    Raises:
        MapError: If there is none, or several.
    """
    ids = [map_.mission_id(row) for row in range(len(map_.missions))]
    names = map_.missions.name.tolist()
    rows = [row for row, found in enumerate(ids) if text and found.startswith(text)]
    rows = rows or [row for row, name in enumerate(names) if name == text]
    if len(rows) != 1:
        known = ", ".join(f"{i} {name!r}" for i, name in zip(ids, names, strict=True)) or "none"
        count = "several missions are" if rows else "no mission is"
        raise MapError(f"{count} called {text!r}; the map has {known}")
    return rows[0]


def nearest_vertices(map_: Map, mission_row: int, stamps_ns: IntArray) -> IntArray:
    """Return the rows of a mission's vertices nearest in time to stamps (N,); the earlier one of two.

    Raises:
        MapError: If the mission has no vertex, or a stamp lies before the first or after the last.
    """
    rows = map_.vertices_of(mission_row)
    known_ns = map_.vertices.stamp_ns[rows]
    require_inside(map_, mission_row, known_ns, stamps_ns)
    after = np.clip(np.searchsorted(known_ns, stamps_ns), 1, max(1, len(rows) - 1))
    before, after = after - 1, np.minimum(after, len(rows) - 1)
    is_later = stamps_ns - known_ns[before] > known_ns[after] - stamps_ns
    nearest: IntArray = rows[np.where(is_later, after, before)]
    return nearest


def require_inside(map_: Map, mission_row: int, known_ns: IntArray, stamps_ns: IntArray) -> None:
    """Refuse stamps outside a mission.

    Raises:
        MapError: If the mission has no vertex, or a stamp lies before the first or after the last.
    """
    name = map_.mission_id(mission_row)
    if not len(known_ns):
        raise MapError(f"mission {name} has no vertices")
    outside = (stamps_ns < known_ns[0]) | (stamps_ns > known_ns[-1])
    if outside.any():
        span = f"{known_ns[0]} to {known_ns[-1]} ns"
        raise MapError(
            f"{stamps_ns[outside][0]} ns lies outside mission {name}, which spans {span}"
        )
