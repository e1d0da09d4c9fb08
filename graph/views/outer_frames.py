"""Outer frames of a stored map, and what was measured in them against where the map has it."""

from __future__ import annotations

import json

import numpy as np
import rerun as rr

from mapstream.graph.views.colors import switch_colors
from mapstream.graph.views.growing import MAP_PATH
from mapstream.graph.views.landmarks import axes
from mapstream.graph.views.scene import Entry
from mapstream.recordings.maps import Map
from mapstream.streams.arrays import FloatArray, IntArray

_KINDS = ("absolute", "position")  # of edges whose transform is T_frame_sensor
_AXIS_M = 2.0
_THIN = rr.Radius.ui_points(1.5)


def outer_frame_entries(map_: Map) -> list[Entry]:
    """Return the axes of each outer frame, and absolute measurements by kind, coloured by their switch."""
    frames = map_.frames
    drawing = []
    for row, name in enumerate(frames.name):
        T = frames.T_map_frame[row : row + 1]
        path = f"{MAP_PATH}/frames/{rr.escape_entity_path_part(name)}"
        label = name if frames.is_known[row] else f"{name} (estimated)"
        drawing += [
            Entry.of(path, axes(T, _AXIS_M)),
            Entry.of(f"{path}/name", rr.Points3D(T[:, :3, 3], labels=[label])),
        ]
    edges = map_.edges
    for kind in _KINDS:
        rows = np.flatnonzero((edges.kind == kind) & (edges.vertex_a >= 0))
        if len(rows):
            drawing += _measured(map_, rows, f"{MAP_PATH}/edges/{kind}")
    return drawing


def _measured(map_: Map, rows: IntArray, path: str) -> list[Entry]:
    """Return where a sensor was measured to be, tied to where the map has it."""
    edges = map_.edges
    T_map_frame = np.concatenate([map_.frames.T_map_frame, np.eye(4)[None]])  # the last: the map
    measured = (T_map_frame[edges.frame[rows]] @ edges.T_a_b[rows])[:, :3, 3]
    t_base_sensor = np.array([_lever(edges.payload[row]) for row in rows])
    T_map_base = map_.T_map_base(edges.vertex_a[rows])
    found = (T_map_base[:, :3, :3] @ t_base_sensor[:, :, None])[..., 0] + T_map_base[:, :3, 3]
    colors = switch_colors(edges.switch[rows])
    ties = np.stack([found, measured], axis=1).astype(np.float32)
    return [
        Entry.of(path, rr.LineStrips3D(ties, colors=colors, radii=_THIN)),
        Entry.of(f"{path}/places", rr.Points3D(measured, colors=colors, radii=_THIN)),
    ]


def _lever(payload: bytes) -> FloatArray:
    """Return where the sensor sits on the base (3,); at its origin where the payload does not say."""
    try:
        t = np.array(json.loads(payload)["T_base_sensor"][:3], dtype=np.float64)
    except (ValueError, KeyError, TypeError):
        return np.zeros(3)
    return t if t.shape == (3,) and np.isfinite(t).all() else np.zeros(3)
