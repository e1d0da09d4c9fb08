"""Measurements on single poses: positions and poses in outer frames, where satellites or cameras saw the robot."""

from __future__ import annotations

import rerun as rr

from mapstream.graph.views.objects import view_recognised
from mapstream.graph.views.planes import view_plane_constraint
from mapstream.graph.views.scene import MAP, Drawing, Entry, Scene, placed
from mapstream.graph.views.unknown import view_unknown
from mapstream.recordings.maps import Map
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint

_MEASURED = 0xE69F00FF


def view_constraint(constraint: Constraint, scene: Scene) -> Drawing:
    """Draw where the robot was seen, in the outer frame, or the plane or thing it saw; other kinds as numbers."""
    if constraint.kind == "plane":
        return view_plane_constraint(constraint, scene)
    if constraint.kind == "landmark":
        return view_recognised(constraint, scene)
    if constraint.kind not in ("position", "absolute"):
        return view_unknown(constraint, scene)
    path, points = scene.line("places", constraint.T_a_b.t)
    marks = rr.Points3D(points, colors=_MEASURED, radii=rr.Radius.ui_points(2.5))
    if constraint.outer is None:
        return [Entry.of(path, marks)]
    frame = _frame(constraint.outer.name)
    drawing = scene.within(path, frame, marks)
    if scene.once(frame):
        T_map_frame = constraint.outer.T_map_frame or SE3.identity()
        drawing.append(placed(frame, MAP, T_map_frame))  # until a map says better
    return drawing


def place_frames(map_: Map) -> list[Entry]:
    """Return the entries that move outer frames to where the map has them."""
    return [
        placed(_frame(name), MAP, SE3(T_map_frame))
        for name, T_map_frame in zip(map_.frames.name, map_.frames.T_map_frame, strict=True)
    ]


def _frame(name: str) -> str:
    return f"outer:{name}"
