"""Missions by what people call them."""

from __future__ import annotations

from mapstream.recordings.maps.model import Map
from mapstream.streams.errors import MapError


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
