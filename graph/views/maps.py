"""A map as it is stored: missions, loops by their switch, landmarks, clouds."""

from __future__ import annotations

import numpy as np
import rerun as rr

from mapstream.graph.views.colors import mission_color, ramp_colors, switch_colors
from mapstream.graph.views.scene import MAP, Columns, Drawing, Entry, Scene, within
from mapstream.recordings.maps import Map

_LINE = rr.Radius.ui_points(2.5)
_QUIET = ("odometry", "imu")  # kinds whose edges follow the trajectory


def view_map(map_: Map, scene: Scene) -> Drawing:
    """Draw each mission's trajectory, the edges beside it, and landmarks by kind."""
    drawing: list[Entry | Columns] = []
    for row in range(len(map_.missions)):
        mission_id = map_.mission_id(row)
        vertices = map_.vertices_of(row)
        positions = map_.T_map_base(vertices)[:, :3, 3]
        color = mission_color(scene.mission_number(mission_id))
        line = rr.LineStrips3D([positions], colors=color, radii=_LINE)
        if len(positions):
            drawing.append(within(f"missions/{mission_id[:8]}", MAP, line))
    return [*drawing, *_edges(map_), *_landmarks(map_)]


def _edges(map_: Map) -> list[Entry]:
    """Return the edges between vertices that do not just follow the trajectory, a path per kind."""
    drawing = []
    edges = map_.edges
    for kind in dict.fromkeys(edges.kind):
        rows = np.flatnonzero((edges.kind == kind) & (edges.vertex_b >= 0))
        if kind in _QUIET or not len(rows):
            continue
        ends = [map_.T_map_base(v[rows])[:, :3, 3] for v in (edges.vertex_a, edges.vertex_b)]
        lines = np.stack(ends, axis=1).astype(np.float32)
        strips = rr.LineStrips3D(lines, colors=switch_colors(edges.switch[rows]), radii=_LINE)
        drawing.append(within(f"edges/{kind}", MAP, strips))
    return drawing


def _landmarks(map_: Map) -> list[Entry]:
    """Return the landmarks, a path per kind, coloured by height."""
    drawing = []
    landmarks = map_.landmarks
    for kind in dict.fromkeys(landmarks.kind):
        rows = np.flatnonzero(landmarks.kind == kind)
        T_map_base = map_.T_map_base(landmarks.vertex[rows])
        p_base = landmarks.p_base[rows, :, None]
        points = (T_map_base[:, :3, :3] @ p_base)[..., 0] + T_map_base[:, :3, 3]
        low, high = np.percentile(points[:, 2], [2, 98])
        colors = ramp_colors(points[:, 2], float(low), float(high))
        marks = rr.Points3D(points, colors=colors, radii=rr.Radius.ui_points(2))
        drawing.append(within(f"landmarks/{kind}", MAP, marks))
    return drawing
