"""From rays to pixels and back, for every model and distortion of `CameraCalibration`.

The unified model puts points on the unit sphere, and looks at them from `xi` behind its centre; pinhole is the
unified model with xi = 0. Source: Mei and Rives, Single View Point Omnidirectional Camera Calibration
from Planar Grids, ICRA 2007.

A point without a pixel, and a pixel without a ray, become NaN. They are: points at or behind the plane of a
pinhole, or outside the cone that a unified camera can see; what lies beyond the radius up to which the
distortion grows; pixels farther out than the largest angle reaches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.distortion import distort, distortion_by_parameters, undistort


@dataclass(frozen=True, slots=True, eq=False)
class _Plane:
    """Points on the normalised plane, which is at distance 1 from where the unified camera looks from."""

    points: FloatArray  # (N, 2); NaN for points that the camera cannot see
    depths: FloatArray  # (N,) [m], z + xi * distance; NaN as well
    distances: FloatArray  # (N,) [m]


def project(camera: CameraCalibration, points: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the pixels of points, and which points have one.

    Args:
        camera: The intrinsics.
        points: Shape (N, 3), in the sensor's frame (x right, y down, z along the view) [m].

    Returns:
        Pixels of shape (N, 2), which may lie outside the image; and a mask (N,).
        Rows outside the mask are NaN.
    """
    plane = _to_plane(camera, np.asarray(points, dtype=np.float64))
    bent = distort(camera.distortion, camera.distortion_parameters, plane.points).points
    return bent * camera.focal_px + camera.center_px, np.isfinite(bent[:, 0])


def unproject(camera: CameraCalibration, px: FloatArray) -> FloatArray:
    """Return the unit rays (N, 3) in the sensor's frame of pixels (N, 2); NaN where no ray meets a pixel."""
    bent = (np.asarray(px, dtype=np.float64) - camera.center_px) / camera.focal_px
    plane = undistort(camera.distortion, camera.distortion_parameters, bent)
    xi = camera.xi or 0.0
    r2 = (plane * plane).sum(axis=1)
    with np.errstate(invalid="ignore"):  # beyond the sphere's outline there is no ray
        reach = (xi + np.sqrt(1 + (1 - xi * xi) * r2)) / (1 + r2)
    return np.concatenate([reach[:, None] * plane, (reach - xi)[:, None]], axis=1)


def projection_jacobians(
    camera: CameraCalibration, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return how pixels move with their points and with the intrinsics.

    Args:
        camera: The intrinsics.
        points: Shape (N, 3), in the sensor's frame [m].

    Returns:
        Derivatives by the point, shape (N, 2, 3) [px/m]; and by fx, fy, cx, cy, xi (if the camera has
        one) and the distortion's parameters in their order, shape (N, 2, P).
        Both are NaN for points without a pixel.
    """
    points = np.asarray(points, dtype=np.float64)
    plane = _to_plane(camera, points)
    bent = distort(camera.distortion, camera.distortion_parameters, plane.points)
    by_plane = camera.focal_px[:, None] * bent.by_point
    by_point: FloatArray = by_plane @ _plane_by_point(camera, points, plane)
    by_focal = bent.points[:, :, None] * np.eye(2)
    by_center = np.where(np.isfinite(by_focal), np.eye(2), np.nan)
    by_lens = distortion_by_parameters(
        camera.distortion, camera.distortion_parameters, plane.points
    )
    by_lens[np.isnan(bent.points[:, 0])] = np.nan
    columns = [by_focal, by_center, camera.focal_px[:, None] * by_lens]
    if camera.xi is not None:
        plane_by_xi = -plane.points * (plane.distances / plane.depths)[:, None]
        columns.insert(2, by_plane @ plane_by_xi[:, :, None])
    return by_point, np.concatenate(columns, axis=2)


def _to_plane(camera: CameraCalibration, points: FloatArray) -> _Plane:
    xi = camera.xi or 0.0
    distances = np.linalg.norm(points, axis=1)
    z = points[:, 2]
    seen = z > -distances * (xi if xi <= 1 else 1 / xi)
    depths = np.where(seen, z + xi * distances, np.nan)
    return _Plane(points[:, :2] / depths[:, None], depths, distances)


def _plane_by_point(camera: CameraCalibration, points: FloatArray, plane: _Plane) -> FloatArray:
    """Return derivatives (N, 2, 3) of x / depth and y / depth."""
    directions = points / np.where(np.isnan(plane.depths), np.nan, plane.distances)[:, None]
    depth_by_point = np.array([0.0, 0.0, 1.0]) + (camera.xi or 0.0) * directions
    jacobian = np.eye(2, 3) - plane.points[:, :, None] * depth_by_point[:, None, :]
    scaled: FloatArray = jacobian / plane.depths[:, None, None]
    return scaled
