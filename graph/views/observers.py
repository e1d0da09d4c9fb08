"""From where a map's landmarks were seen: rays from landmarks to their observers."""

from __future__ import annotations

import numpy as np
import rerun as rr

from mapstream.graph.views.colors import ramp_colors
from mapstream.graph.views.growing import MAP_PATH
from mapstream.graph.views.scene import Entry
from mapstream.recordings.maps import Map

_MAX_RAYS = 20_000  # more hide each other
_RAY = rr.Radius.ui_points(0.4)
_LONG = 20  # observations: a landmark that was seen so often has the ramp's last colour
_OPACITY = 0xFFFFFF30


def observer_entries(map_: Map) -> list[Entry]:
    """Return rays from landmarks to vertices, a path per kind of feature, coloured by number of observers."""
    seen = map_.observations
    rows = np.flatnonzero(seen.landmark >= 0)
    if not len(rows):
        return []
    counts = np.bincount(seen.landmark[rows], minlength=len(map_.landmarks))
    rows = rows[:: max(1, len(rows) // _MAX_RAYS)]
    landmarks = map_.T_map_landmark(seen.landmark[rows])[:, :3, 3]
    observers = map_.T_map_base(seen.vertex[rows])[:, :3, 3]
    rays = np.stack([landmarks, observers], axis=1).astype(np.float32)
    colors = ramp_colors(counts[seen.landmark[rows]].astype(np.float64), 1, _LONG) & _OPACITY
    kinds = map_.landmarks.kind[seen.landmark[rows]]
    entries = []
    for kind in dict.fromkeys(kinds):
        of_kind = kinds == kind
        strips = rr.LineStrips3D(rays[of_kind], colors=colors[of_kind], radii=_RAY)
        path = f"{MAP_PATH}/observers/{rr.escape_entity_path_part(kind)}"
        entries.append(Entry.of(path, strips))
    return entries
