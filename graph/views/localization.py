"""The robot in a map that was made before."""

from __future__ import annotations

import rerun as rr

from mapstream.graph.views.colors import ACCEPTED, MISSIONS, REFUSED
from mapstream.graph.views.growing import LINE
from mapstream.graph.views.scene import MAP, ODOM, Columns, Drawing, Entry, Scene, placed, transform
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapPose

_COLORS = {"lost": REFUSED | 0xFF, "tracking": ACCEPTED, "recovered": MISSIONS[0]}


def view_map_pose(pose: MapPose, scene: Scene) -> Drawing:
    """Place the robot, coloured by state, and say what came of the frame; while lost it stays where it was last."""
    drawing = list(_said(pose))
    T_map_base = pose.T_map_base
    if T_map_base is not None:
        is_gap = pose.state == "recovered"
        stretch = scene.located.get(scene.path, (0, T_map_base))[0] + is_gap
        scene.located[scene.path] = stretch, T_map_base
        drawing += _way(f"way/{stretch}", T_map_base, scene)
        if is_gap:
            again = rr.Points3D(
                [T_map_base.t], colors=_COLORS["recovered"], radii=rr.Radius.ui_points(6)
            )
            drawing.append(Entry.of(f"recovered/{stretch}", again))
    if scene.path in scene.located:
        body = rr.Boxes3D(half_sizes=[0.55, 0.35, 0.25], colors=_COLORS[pose.state])
        drawing.append(Entry.of("robot", transform(scene.located[scene.path][1]), body))
    if pose.T_map_odom is not None and not _moves_robot(scene):
        scene.T_map_odom = pose.T_map_odom
        drawing.append(placed(ODOM, MAP, pose.T_map_odom))
    return drawing


def _way(name: str, T_map_base: SE3, scene: Scene) -> list[Entry | Columns]:
    path, points = scene.line(name, T_map_base.t)
    return [Entry.of(path, rr.LineStrips3D(points[None], colors=_COLORS["tracking"], radii=LINE))]


def _said(pose: MapPose) -> Drawing:
    """Return the plot and the line of the log of a frame that was compared, and the line of a recovery."""
    if pose.verdict:
        yield Entry.of("inliers", rr.Scalars(float(pose.num_inliers)))
    elif pose.state != "recovered":
        return
    level = rr.TextLogLevel.WARN if pose.state == "lost" else rr.TextLogLevel.INFO
    text = f"{pose.state}: {pose.verdict or 'no frame'}, {pose.num_inliers} inliers"
    yield Entry.of("log", rr.TextLog(text, level=level, color=_COLORS[pose.state]))


def _moves_robot(scene: Scene) -> bool:
    """Return whether odometry of the same operator does, which lies in the map already."""
    main = scene.main_odometry
    return main is not None and main.split("/")[0] == scene.path.split("/")[0]
