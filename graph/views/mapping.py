"""Keyframes, submaps, loop closures and corrections: the map while it grows."""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from mapstream.graph.views.ceiling import is_below_ceiling
from mapstream.graph.views.colors import ACCEPTED, DRIVEN, REFUSED, mission_color
from mapstream.graph.views.growing import MAP_PATH, redraw_loops, redraw_mission
from mapstream.graph.views.lidar import height_colors, thinned
from mapstream.graph.views.scene import MAP, ODOM, Columns, Drawing, Entry, Scene, placed, transform
from mapstream.streams.arrays import Float32Array
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import (
    Keyframe,
    LoopCandidate,
    LoopReport,
    MapCorrection,
    Submap,
)

_CLOUD_SIZE = rr.Radius.ui_points(1.2)
_THIN = rr.Radius.ui_points(1.0)


def view_keyframe(keyframe: Keyframe, scene: Scene) -> Drawing:
    """Mark where a keyframe was taken."""
    path, points = scene.line("places", keyframe.odometry.T_odom_base.t)
    marks = rr.Points3D(points, colors=DRIVEN, radii=rr.Radius.ui_points(3))
    return scene.within(path, ODOM, marks)


def view_submap(submap: Submap, scene: Scene) -> Drawing:
    """Draw a submap in a frame of its own, which corrections move: points, keyframes and edges."""
    color = mission_color(scene.mission_number(submap.mission_id))
    first = submap.keyframes[0]
    path = f"{MAP_PATH}/submaps/{submap.mission_id[:8]}/{submap.index}"
    T_map_submap = scene.T_map_odom @ first.odometry.T_odom_base
    scene.submaps[path] = (submap.mission_id, first.stamp_ns), T_map_submap
    T_submap_odom = first.odometry.T_odom_base.inverse()
    poses = [T_submap_odom @ keyframe.odometry.T_odom_base for keyframe in submap.keyframes]
    at = {k.stamp_ns: pose.t for k, pose in zip(submap.keyframes, poses, strict=True)}
    lines = [
        (at[edge.stamp_a_ns], at[edge.stamp_b_ns])
        for edge in submap.edges
        if edge.stamp_a_ns in at and edge.stamp_b_ns in at
    ]
    marks = rr.Points3D(list(at.values()), colors=color, radii=rr.Radius.ui_points(3.5))
    strips = rr.LineStrips3D(np.array(lines, dtype=np.float32), colors=color, radii=_THIN)
    cloud = _cloud(submap, poses, scene.settings.max_submap_points)
    points = rr.Points3D(cloud, colors=height_colors(cloud[:, 2], scene), radii=_CLOUD_SIZE)
    return [
        Entry.of(path, transform(T_map_submap)),
        Entry.of(f"{path}/keyframes", marks),
        *([Entry.of(f"{path}/edges", strips)] if lines else []),
        *([Entry.of(f"{path}/cloud", points)] if len(cloud) else []),
    ]


def view_loop_report(report: LoopReport, scene: Scene) -> Drawing:
    """Draw accepted loops (all so far) and those just refused, and say why."""
    for edge in report.edges:
        ends = (edge.mission_a, edge.stamp_a_ns), (edge.mission_b, edge.stamp_b_ns)
        scene.loops.setdefault(ends, 1.0)
    drawing: list[Entry | Columns] = [*redraw_loops(scene)]
    refused = [c for c in report.candidates if c.verdict != "accepted"]
    found = [scene.places([c.stamp_a_ns, c.stamp_b_ns]) for c in refused]
    pairs = [pair for pair in found if pair is not None]
    lines = np.array(pairs, dtype=np.float32).reshape(-1, 2, 3)
    drawing.append(Entry.of("refused", rr.LineStrips3D(lines, colors=REFUSED, radii=_THIN)))
    return [*drawing, *map(_said, report.candidates)]


def _said(candidate: LoopCandidate) -> Entry:
    """Return the line of the log that says what became of a candidate."""
    span_s = abs(candidate.stamp_b_ns - candidate.stamp_a_ns) / 1e9
    text = f"{candidate.verdict}: {span_s:.1f} s apart, {candidate.distance_m:.1f} m away"
    if math.isfinite(candidate.rmse_m):  # else it was not even registered
        text += f", inliers {candidate.inlier_fraction:.0%}, rmse {candidate.rmse_m:.3f} m"
    if candidate.verdict == "accepted":
        return Entry.of("log", rr.TextLog(text, level=rr.TextLogLevel.INFO, color=ACCEPTED))
    return Entry.of("log", rr.TextLog(text, level=rr.TextLogLevel.DEBUG, color=REFUSED | 0xFF))


def view_map_correction(correction: MapCorrection, scene: Scene) -> Drawing:
    """Draw the corrected trajectory; move odometry, submaps and loops to where they belong now."""
    T_map_mission = correction.T_map_mission or SE3.identity()
    scene.T_map_odom = T_map_mission @ correction.T_mission_odom
    T_map_base = T_map_mission.matrix @ correction.T_mission_base
    moved = redraw_mission(scene, correction.mission_id, correction.stamps_ns, T_map_base)
    return [placed(ODOM, MAP, scene.T_map_odom), *moved, *redraw_loops(scene)]


def _cloud(submap: Submap, poses: list[SE3], max_points: int) -> Float32Array:
    """Return the submap's points (N, 3) in its own frame, less the cloud it shares with the one before."""
    pairs = list(zip(submap.keyframes, poses, strict=True))[1 if submap.index else 0 :]
    each = max(1, max_points // max(1, len(pairs)))
    clouds = [
        pose @ thinned(keyframe.cloud.points, None, each)[0]
        for keyframe, pose in pairs
        if keyframe.cloud is not None
    ]
    points = np.concatenate([np.empty((0, 3)), *clouds]).astype(np.float32)
    return points[is_below_ceiling(points, np.array([pose.t for pose in poses]))]
