"""Scans and clouds."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import rerun as rr

from mapstream.graph.views.colors import ColorArray, photographed, ramp_colors
from mapstream.graph.views.scene import BASE, Drawing, Scene, sensor_frame
from mapstream.streams.arrays import Float32Array
from mapstream.streams.messages.estimates import PointCloud
from mapstream.streams.messages.sensors import LaserScan2D, LidarScan, OrganizedCloud

_POINT_SIZE = rr.Radius.ui_points(1.5)  # a scan of the moment, not yet in the map
_BEAM_SIZE = rr.Radius.ui_points(3.0)


def view_lidar_scan(scan: LidarScan, scene: Scene) -> Drawing:
    """Draw the points where the sensor sits, coloured by intensity, else by height."""
    mount = scene.mount(scan.frame, scan.T_base_sensor)
    points, intensity = thinned(scan.points, scan.intensity, scene.settings.max_points)
    colors = _point_colors(points, intensity, scene)
    cloud = rr.Points3D(points, colors=colors, radii=_POINT_SIZE)
    return [*mount, *scene.within("", sensor_frame(scan.frame), cloud)]


def view_organized_cloud(cloud: OrganizedCloud, scene: Scene) -> Drawing:
    """Draw the points where the camera sits, in their own colours, else by height."""
    mount = scene.mount(cloud.frame, cloud.T_base_sensor)
    is_seen = np.isfinite(cloud.points[..., 2])
    seen = cloud.points[is_seen]
    step = _step(len(seen), scene.settings.max_points)
    points = seen[::step]
    colors: ColorArray | npt.NDArray[np.uint8] = height_colors(points[:, 2], scene)
    if cloud.colors_rgb is not None:
        colors = cloud.colors_rgb[is_seen][::step]
    drawn = rr.Points3D(points, colors=colors, radii=_POINT_SIZE)
    return [*mount, *scene.within("", sensor_frame(cloud.frame), drawn)]


def view_point_cloud(cloud: PointCloud, scene: Scene) -> Drawing:
    """Draw the points around the robot, as cameras saw them, else coloured by intensity, else by height."""
    points, intensity = thinned(cloud.points, cloud.intensity, scene.settings.max_points)
    colors = _point_colors(points, intensity, scene)
    if cloud.colors_rgba is not None:
        step = _step(len(cloud.points), scene.settings.max_points)
        colors = photographed(colors, cloud.colors_rgba[::step])
    return scene.within("", BASE, rr.Points3D(points, colors=colors, radii=_POINT_SIZE))


def view_laser_scan(scan: LaserScan2D, scene: Scene) -> Drawing:
    """Draw the ends of the beams that hit something."""
    mount = scene.mount(scan.frame, scan.T_base_sensor)
    ranges = scan.ranges_m
    is_hit = (ranges >= scan.range_min_m) & (ranges <= scan.range_max_m)
    angles = scan.angle_min_rad + np.flatnonzero(is_hit) * scan.angle_step_rad
    ends = ranges[is_hit, None] * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=-1)
    beams = rr.Points3D(ends.astype(np.float32), colors=0xFFD54FFF, radii=_BEAM_SIZE)
    return [*mount, *scene.within("", sensor_frame(scan.frame), beams)]


def thinned(
    points: Float32Array, intensity: Float32Array | None, max_points: int
) -> tuple[Float32Array, Float32Array | None]:
    """Return every n-th point (M, 3) and its intensity (M,), so that there are at most `max_points`."""
    step = _step(len(points), max_points)
    return points[::step], None if intensity is None else intensity[::step]


def _step(num: int, max_points: int) -> int:
    return max(1, -(-num // max_points)) if max_points else 1


def height_colors(heights_m: npt.NDArray[np.floating], scene: Scene) -> ColorArray:
    """Return colours of heights, on the scale of the first cloud that this output drew."""
    low, high = scene.remember("heights", _spread(heights_m))
    return ramp_colors(heights_m, low, high, "turbo")


def _point_colors(points: Float32Array, intensity: Float32Array | None, scene: Scene) -> ColorArray:
    if intensity is None or not len(intensity) or np.ptp(intensity) == 0:
        return height_colors(points[:, 2], scene)
    low, high = scene.remember("intensities", _spread(intensity))
    return ramp_colors(intensity, low, high, "viridis")


def _spread(values: npt.NDArray[np.floating]) -> tuple[float, float]:
    """Return the range that holds all but the extreme values."""
    if not len(values):
        return 0.0, 1.0
    low, high = np.percentile(values, [2, 98])
    return float(low), float(high)
