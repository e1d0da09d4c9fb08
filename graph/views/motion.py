"""Motion as sensors and odometry tell it."""

from __future__ import annotations

from itertools import islice

import numpy as np
import rerun as rr

from mapstream.graph.views.colors import AXES, DRIVEN, ROBOT
from mapstream.graph.views.scene import (
    BASE,
    ODOM,
    Columns,
    Drawing,
    Entry,
    Scene,
    placed,
    transform,
)
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import GnssFix, ImuBatch, TransformBatch, WheelOdometry

_TRAIL_LENGTH = 100  # positions since the last correction


def view_imu_batch(imu: ImuBatch, scene: Scene) -> Drawing:
    """Plot angular rate and specific force."""
    drawing: list[Entry | Columns] = []
    if scene.once("styles"):
        lines = rr.SeriesLines(names=["x", "y", "z"], colors=AXES)
        drawing += [Entry.of(name, lines, is_static=True) for name in ("gyro", "accel")]
    drawing.append(_plot("gyro", imu.stamps_ns, imu.gyro_radps))
    drawing.append(_plot("accel", imu.stamps_ns, imu.accel_mps2))
    return drawing


def view_odometry(odometry: Odometry, scene: Scene) -> Drawing:
    """Move the robot and draw where it drove, before any correction."""
    drawing = _motion(odometry.stamp_ns, odometry.T_odom_base, scene)
    if odometry.velocity_mps is not None:
        drawing.append(Entry.of("speed", rr.Scalars(float(np.linalg.norm(odometry.velocity_mps)))))
    if odometry.is_lost:
        text = "this step could not be measured: the pose is a prediction"
        drawing.append(Entry.of("log", rr.TextLog(text, level=rr.TextLogLevel.WARN)))
    return drawing


def view_wheel_odometry(odometry: WheelOdometry, scene: Scene) -> Drawing:
    """As odometry: it moves the robot where nothing better does."""
    return _motion(odometry.stamp_ns, odometry.T_odom_base, scene)


def view_gnss_fix(fix: GnssFix, scene: Scene) -> Drawing:  # noqa: ARG001  # a view
    """Draw the fix on the earth."""
    place = rr.GeoPoints(
        lat_lon=[fix.latitude_deg, fix.longitude_deg],
        radii=rr.Radius.ui_points(4.0),
        colors=0x56B4E9FF,
    )
    return [Entry.of("", place), Entry.of("altitude", rr.Scalars(fix.altitude_m))]


def view_transforms(batch: TransformBatch, scene: Scene) -> Drawing:  # noqa: ARG001  # a view
    """Draw the transform tree as it was published; its frames do not meet ours."""
    newest = {child: row for row, child in enumerate(batch.children)}
    for child, row in newest.items():
        T_parent_child = SE3(batch.T_parent_child[row])
        parent = f"tf:{batch.parents[row]}"
        moved = transform(T_parent_child, parent_frame=parent, child_frame=f"tf:{child}")
        yield Entry.of(rr.escape_entity_path_part(child), moved, is_static=batch.is_static)


def _motion(stamp_ns: int, T_odom_base: SE3, scene: Scene) -> list[Entry | Columns]:
    """Return where odometry alone would have gone, and if it moves the robot, the robot."""
    path, points = scene.line("uncorrected", T_odom_base.t)
    line = rr.LineStrips3D(points[None], colors=DRIVEN, radii=rr.Radius.ui_points(1.0))
    drawing: list[Entry | Columns] = [Entry.of(path, line)]
    if not scene.is_main():
        return drawing
    drawing.append(placed(BASE, ODOM, T_odom_base))
    scene.driven[stamp_ns] = T_odom_base.t
    newest = np.array([*islice(reversed(scene.driven.values()), _TRAIL_LENGTH)], dtype=np.float32)
    trail = rr.LineStrips3D(newest[None], colors=ROBOT, radii=rr.Radius.ui_points(1.5))
    drawing += scene.within("trail", ODOM, trail)
    if scene.once("robot"):
        body = rr.Boxes3D(half_sizes=[0.5, 0.3, 0.2], colors=ROBOT, fill_mode="solid")
        frame = rr.CoordinateFrame(BASE)
        drawing.append(Entry.of("robot", frame, body, is_static=True))
    return drawing


def _plot(path: str, stamps_ns: IntArray, values: FloatArray) -> Columns:
    """Return a plot of rows (N, 3)."""
    columns = rr.Scalars.columns(scalars=values.reshape(-1)).partition([3] * len(values))
    return Columns(path, stamps_ns, columns)
