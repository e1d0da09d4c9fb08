"""The pose that fits all sightings best, with its covariance: reprojections in pixels, 3D points in metres."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mapstream.operators.places.geometry.sightings import Sightings
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project, projection_jacobians
from mapstream.streams.geometry import SE3, hat, se3_exp, straightened

_STEPS = 10
_SMALL = 1e-6  # a step that changes nothing any more
_HUBER = 2.0  # standard deviations


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """How far sightings may be from the map by noise alone."""

    sigma_px: float
    sigma_m: float  # of 3D points whose own is smaller, or not known


@dataclass(frozen=True, slots=True, eq=False)
class RefinedPose:
    """A pose of the base; the covariance's tangent is on its right, rotation first."""

    T_map_base: SE3
    covariance: FloatArray  # (6, 6)


def refine(sightings: Sightings, T_map_base: FloatArray, noise: Noise) -> RefinedPose:
    """Return the pose at which the weighted errors of all sightings are least (Gauss-Newton, Huber).

    Args:
        sightings: Inliers.
        T_map_base: A start (4, 4).
        noise: Of the sightings.
    """
    T = T_map_base
    information = np.eye(6)
    for _ in range(_STEPS):
        residuals, jacobian = _linearised(sightings, T, noise)
        weights = np.minimum(1, _HUBER / np.maximum(np.linalg.norm(residuals, axis=1), 1e-12))
        weighted = weights[:, None, None] * jacobian
        information = np.einsum("nri,nrj->ij", weighted, jacobian)
        step = np.linalg.lstsq(information, -np.einsum("nri,nr->i", weighted, residuals))[0]
        T = straightened(T @ se3_exp(step))
        if np.abs(step).max() < _SMALL:
            break
    residuals, _ = _linearised(sightings, T, noise)
    spare = max(2 * len(residuals) - 6, 1)
    scale = max(
        float((residuals**2).sum()) / spare, 1.0
    )  # never better than the noise that is claimed
    covariance = scale * np.linalg.pinv(information, hermitian=True)
    return RefinedPose(SE3(T), (covariance + covariance.T) / 2)


def errors(sightings: Sightings, T_map_base: FloatArray, noise: Noise) -> FloatArray:
    """Return how many standard deviations each sighting is off (N,); inf where it cannot be seen."""
    residuals = np.full((len(sightings), 3), np.inf)
    points = _points_base(sightings, T_map_base)
    for rows, (calibration, R, t) in _by_camera(sightings):
        px = project(calibration, points[rows] @ R.T + t)[0]
        residuals[rows, :2] = (px - sightings.keypoints_px[rows]) / noise.sigma_px
        residuals[rows, 2] = 0
    has_point = sightings.has_point
    shifts = points[has_point] - sightings.points_base()[has_point]
    residuals[has_point] = shifts / _sigmas_m(sightings, noise)[has_point, None]
    lengths: FloatArray = np.linalg.norm(np.where(np.isnan(residuals), np.inf, residuals), axis=1)
    return lengths


def _linearised(
    sightings: Sightings, T_map_base: FloatArray, noise: Noise
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (N, 3) in standard deviations and derivatives (N, 3, 6) by the pose's tangent.

    Of a ray the third row is zero; so are all rows of what cannot be seen from the pose.
    """
    points = _points_base(sightings, T_map_base)
    by_pose = np.concatenate([hat(points), np.tile(-np.eye(3), (len(points), 1, 1))], axis=2)
    residuals, jacobian = np.zeros((len(points), 3)), np.zeros((len(points), 3, 6))
    for all_rows, (calibration, R, t) in _by_camera(sightings):
        in_sensor = points[all_rows] @ R.T + t
        px, is_seen = project(calibration, in_sensor)
        rows, px, in_sensor = all_rows[is_seen], px[is_seen], in_sensor[is_seen]
        residuals[rows, :2] = (px - sightings.keypoints_px[rows]) / noise.sigma_px
        by_point = projection_jacobians(calibration, in_sensor)[0]
        jacobian[rows, :2] = by_point @ (R @ by_pose[rows]) / noise.sigma_px
    has_point = sightings.has_point
    sigmas = _sigmas_m(sightings, noise)[has_point]
    shifts = points[has_point] - sightings.points_base()[has_point]
    residuals[has_point] = shifts / sigmas[:, None]
    jacobian[has_point] = by_pose[has_point] / sigmas[:, None, None]
    return residuals, jacobian


def _points_base(sightings: Sightings, T_map_base: FloatArray) -> FloatArray:
    points: FloatArray = (sightings.points_map - T_map_base[:3, 3]) @ T_map_base[:3, :3]
    return points


def _sigmas_m(sightings: Sightings, noise: Noise) -> FloatArray:
    return np.fmax(sightings.sigmas_m, noise.sigma_m)


def _by_camera(sightings: Sightings) -> Iterator[tuple[IntArray, _Eye]]:
    """Yield for each camera the rows of its rays, and how it sees points of the base."""
    has_ray = sightings.has_ray
    for number, sensor in enumerate(sightings.sensors):
        rows = np.flatnonzero(has_ray & (sightings.sensor == number))
        if sensor.calibration is not None and len(rows):
            T_sensor_base = sensor.T_base_sensor.inverse()
            yield rows, _Eye(sensor.calibration, T_sensor_base.R, T_sensor_base.t)


class _Eye(NamedTuple):
    calibration: CameraCalibration
    R_sensor_base: FloatArray
    t_sensor_base: FloatArray
