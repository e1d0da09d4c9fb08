"""Rooms and places of a map: outlines with names."""

from __future__ import annotations

import numpy as np
import rerun as rr

from mapstream.graph.views.colors import mission_color
from mapstream.graph.views.growing import MAP_PATH
from mapstream.graph.views.scene import Entry
from mapstream.operators.maps.regions import Region, regions_of
from mapstream.recordings.maps import Map
from mapstream.streams.arrays import FloatArray

_PLACE = rr.Radius.ui_points(5)
_LINE = rr.Radius.ui_points(1.5)


def region_entries(map_: Map) -> list[Entry]:
    """Return the outlines of regions with their names, floor and ceiling if they have them; places as points."""
    regions = regions_of(map_)
    rooms = [region for region in regions if len(region.corners) > 1]
    places = [region for region in regions if len(region.corners) == 1]
    strips, labels, colors = [], [], []
    for number, room in enumerate(rooms):
        lines = _outline(room)
        strips += lines
        labels += [room.name, *[""] * (len(lines) - 1)]
        colors += [mission_color(number)] * len(lines)
    drawing = []
    if strips:
        shades = np.array(colors, np.uint32)
        outlines = rr.LineStrips3D(strips, colors=shades, radii=_LINE, labels=labels)
        drawing.append(Entry.of(f"{MAP_PATH}/regions", outlines))
    if places:
        marks = rr.Points3D(
            np.concatenate([place.corners for place in places]),
            radii=_PLACE,
            labels=[place.name for place in places],
        )
        drawing.append(Entry.of(f"{MAP_PATH}/places", marks))
    return drawing


def _outline(region: Region) -> list[FloatArray]:
    """Return closed lines round the floor and the ceiling of a region, and the edges between."""
    floor = np.concatenate([region.corners, region.corners[:1]])
    if not np.isfinite(region.height_m):
        return [floor]
    up = np.array([0.0, 0.0, region.height_m])
    return [floor, floor + up, *(np.stack([corner, corner + up]) for corner in region.corners)]
