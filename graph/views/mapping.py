"""Keyframes, submaps, loop closures and corrections: the map while it grows."""

from __future__ import annotations

import numpy as np
import rerun as rr

from mapstream.graph.views.colors import ACCEPTED, DRIVEN, REFUSED, mission_color
from mapstream.graph.views.lidar import height_colors, thinned
from mapstream.graph.views.scene import MAP, ODOM, Columns, Drawing, Entry, Scene, placed, within
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Keyframe, LoopReport, MapCorrection, Submap
from mapstream.streams.messages.sensors import Float32Array, FloatArray

_CLOUD_SIZE = rr.Radius.ui_points(1.2)
_LINE = rr.Radius.ui_points(2.5)
_THIN = rr.Radius.ui_points(1.0)
_MOVED_M, _MOVED_RAD = 0.005, 0.0005  # a submap that moved less is left where it is


def view_keyframe(keyframe: Keyframe, scene: Scene) -> Drawing:
    """Mark where a keyframe was taken."""
    path, points = scene.trail("places", keyframe.odometry.T_odom_base.t)
    return [within(path, ODOM, rr.Points3D(points, colors=DRIVEN, radii=rr.Radius.ui_points(3)))]


def view_submap(submap: Submap, scene: Scene) -> Drawing:
    """Draw a submap in a frame of its own, which corrections move: points, keyframes and edges."""
    number = scene.mission_number(submap.mission_id)
    first = submap.keyframes[0]
    frame = f"submap:{submap.mission_id[:8]}:{submap.index}"
    T_map_submap = scene.T_map_odom @ first.odometry.T_odom_base
    scene.submaps[frame] = submap.mission_id, first.stamp_ns, T_map_submap
    path = f"{submap.mission_id[:8]}/{submap.index}"
    T_submap_odom = first.odometry.T_odom_base.inverse()
    poses = [T_submap_odom @ keyframe.odometry.T_odom_base for keyframe in submap.keyframes]
    places = np.array([pose.t for pose in poses])
    at = {
        keyframe.stamp_ns: place for keyframe, place in zip(submap.keyframes, places, strict=True)
    }
    ends = [(e.stamp_a_ns, e.stamp_b_ns) for e in submap.edges]
    lines = [(at[a], at[b]) for a, b in ends if a in at and b in at]
    color = mission_color(number)
    drawing: list[Entry | Columns] = [placed(frame, MAP, T_map_submap)]
    cloud = _cloud(submap, poses, scene.settings.max_submap_points)
    if len(cloud):
        colors = height_colors(cloud[:, 2], scene)
        drawing.append(
            within(f"{path}/cloud", frame, rr.Points3D(cloud, colors=colors, radii=_CLOUD_SIZE))
        )
    marks = rr.Points3D(places, colors=color, radii=rr.Radius.ui_points(3.5))
    drawing.append(within(f"{path}/keyframes", frame, marks))
    if lines:
        strips = rr.LineStrips3D(np.array(lines, dtype=np.float32), colors=color, radii=_THIN)
        drawing.append(within(f"{path}/edges", frame, strips))
    return drawing


def view_loop_report(report: LoopReport, scene: Scene) -> Drawing:
    """Draw accepted loops (all so far) and those just refused, and say why."""
    loops = scene.loops.setdefault(scene.path, [])
    loops += [((e.mission_a, e.stamp_a_ns), (e.mission_b, e.stamp_b_ns)) for e in report.edges]
    drawing: list[Entry | Columns] = [*_accepted(scene)]
    refused = [c for c in report.candidates if c.verdict != "accepted"]
    ends = [scene.places([c.stamp_a_ns, c.stamp_b_ns]) for c in refused]
    pairs = [pair for pair in ends if pair is not None]
    lines = np.array(pairs, dtype=np.float32).reshape(-1, 2, 3)
    drawing.append(within("refused", MAP, rr.LineStrips3D(lines, colors=REFUSED, radii=_THIN)))
    for candidate in report.candidates:
        is_accepted = candidate.verdict == "accepted"
        span_s = (candidate.stamp_b_ns - candidate.stamp_a_ns) / 1e9
        text = (
            f"{candidate.verdict}: {abs(span_s):.1f} s apart, {candidate.distance_m:.1f} m away, "
            f"inliers {candidate.inlier_fraction:.0%}, rmse {candidate.rmse_m:.3f} m"
        )
        color = ACCEPTED if is_accepted else REFUSED | 0xFF
        level = rr.TextLogLevel.INFO if is_accepted else rr.TextLogLevel.DEBUG
        drawing.append(Entry.of("log", rr.TextLog(text, level=level, color=color)))
    return drawing


def view_map_correction(correction: MapCorrection, scene: Scene) -> Drawing:
    """Draw the corrected trajectory; move odometry, submaps and loops to where they belong now."""
    number = scene.mission_number(correction.mission_id)
    T_map_mission = correction.T_map_mission or SE3.identity()
    T_map_base = T_map_mission.matrix @ correction.T_mission_base
    positions = T_map_base[:, :3, 3]
    scene.corrected[correction.mission_id] = correction.stamps_ns, positions
    scene.T_map_odom = T_map_mission @ correction.T_mission_odom
    line = rr.LineStrips3D([positions], colors=mission_color(number), radii=_LINE)
    drawing: list[Entry | Columns] = [placed(ODOM, MAP, scene.T_map_odom)]
    if len(positions):
        drawing.append(within(f"trajectory/{correction.mission_id[:8]}", MAP, line))
    drawing += _moved_submaps(correction, T_map_base, scene)
    return [*drawing, *_accepted(scene)]


def _moved_submaps(correction: MapCorrection, T_map_base: FloatArray, scene: Scene) -> list[Entry]:
    moved = []
    rows = {int(stamp): row for row, stamp in enumerate(correction.stamps_ns)}
    for frame, (mission_id, stamp_ns, T_before) in scene.submaps.items():
        if mission_id != correction.mission_id or stamp_ns not in rows:
            continue
        T_now = SE3(T_map_base[rows[stamp_ns]])
        step = T_before.inverse() @ T_now
        if np.linalg.norm(step.t) > _MOVED_M or step.angle_rad > _MOVED_RAD:
            scene.submaps[frame] = mission_id, stamp_ns, T_now
            moved.append(placed(frame, MAP, T_now))
    return moved


def _accepted(scene: Scene) -> list[Entry]:
    """Return the entries that draw every accepted loop where its ends are now."""
    drawing = []
    for path, loops in scene.loops.items():
        ends = [(scene.places([a[1]], a[0]), scene.places([b[1]], b[0])) for a, b in loops]
        lines = [np.concatenate([a, b]) for a, b in ends if a is not None and b is not None]
        if lines:
            strips = rr.LineStrips3D(
                np.array(lines, dtype=np.float32), colors=ACCEPTED, radii=_LINE
            )
            drawing.append(within(f"/{path}/accepted", MAP, strips))
    return drawing


def _cloud(submap: Submap, poses: list[SE3], max_points: int) -> Float32Array:
    """Return the submap's points (N, 3) in its own frame, less the cloud it shares with the one before."""
    pairs = list(zip(submap.keyframes, poses, strict=True))[1 if submap.index else 0 :]
    each = max(1, max_points // max(1, len(pairs)))
    clouds = [
        pose @ thinned(keyframe.cloud.points, None, each)[0]
        for keyframe, pose in pairs
        if keyframe.cloud is not None
    ]
    return np.concatenate([np.empty((0, 3)), *clouds]).astype(np.float32)
