"""Where a camera is, from points whose places are known: reprojection errors made least, for any camera model.

A square has two poses that look much alike (Collins and Bartoli, Infinitesimal Plane-Based Pose Estimation,
IJCV 2014); both are tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project, projection_jacobians, unproject
from mapstream.streams.geometry import SE3, hat

_MAX_STEPS = 10
_CONVERGED = 1e-9  # of a step [rad, m]
_UNSEEN_PX = 1e6  # error of points behind the camera


@dataclass(frozen=True, slots=True, eq=False)
class PointsPose:
    """The frame of some points, as a camera sees it."""

    T_camera_points: SE3
    covariance: (
        FloatArray  # (6, 6) rotation first, of a small motion on the right, for errors of one pixel
    )
    rms_px: float  # of the reprojection errors


def square_corners(size_m: float) -> FloatArray:
    """Return the corners (4, 3) of a marker in its frame, as detectors order them.

    The frame is in the middle, x to the right, y upwards, z towards who reads it.
    """
    half = size_m / 2
    return np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])


def square_poses(
    camera: CameraCalibration, corners: FloatArray, corners_px: FloatArray
) -> list[PointsPose]:
    """Return the poses of a square marker with corners (4, 3) where it was seen (4, 2), the best one first.

    None is returned if the corners are seen along no rays, or make no square.
    """
    rays = unproject(camera, corners_px)
    if not (rays[:, 2] > 0).all():
        return []
    plane = (rays[:, :2] / rays[:, 2:])[:, None]
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        corners, plane, np.eye(3), np.empty(0), flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    found = []
    for rotation, translation in zip(rotations, translations, strict=True):
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            continue
        R = np.asarray(cv2.Rodrigues(rotation)[0])
        start = SE3.from_rotation(R, np.ravel(translation))
        found.append(points_pose(camera, corners, corners_px, start))
    return sorted(found, key=lambda pose: pose.rms_px)


def points_pose(
    camera: CameraCalibration, points: FloatArray, px: FloatArray, T_camera_points: SE3
) -> PointsPose:
    """Return the pose that reprojects points (N, 3), N >= 3, best to where they were seen (N, 2).

    Gauss and Newton's steps from a start that is near.
    """
    information: FloatArray = np.eye(6)
    for _ in range(_MAX_STEPS):
        errors, jacobian = _linearised(camera, points, px, T_camera_points)
        information = jacobian.T @ jacobian
        step = np.linalg.lstsq(information, -jacobian.T @ errors, rcond=None)[0]
        T_camera_points = T_camera_points @ SE3.exp(step)
        if np.abs(step).max() < _CONVERGED:
            break
    return PointsPose(
        T_camera_points=T_camera_points,
        covariance=np.linalg.pinv(information).astype(np.float64),
        rms_px=rms_px(camera, points, px, T_camera_points),
    )


def rms_px(
    camera: CameraCalibration, points: FloatArray, px: FloatArray, T_camera_points: SE3
) -> float:
    """Return how far points (N, 3) are from where they were seen (N, 2): one coordinate of a pixel, rms."""
    predicted, is_seen = project(camera, points @ T_camera_points.R.T + T_camera_points.t)
    errors = np.where(is_seen[:, None], predicted - px, _UNSEEN_PX)
    return float(np.sqrt(np.mean(errors**2)))


def _linearised(
    camera: CameraCalibration, points: FloatArray, px: FloatArray, T_camera_points: SE3
) -> tuple[FloatArray, FloatArray]:
    """Return errors (2N,) [px] and their Jacobian (2N, 6) by a small motion on the right."""
    R = T_camera_points.R
    points_camera = points @ R.T + T_camera_points.t
    predicted, is_seen = project(camera, points_camera)
    by_point = projection_jacobians(camera, points_camera)[0]
    by_motion = np.concatenate([-R @ hat(points), np.broadcast_to(R, (len(points), 3, 3))], axis=2)
    weight = is_seen[:, None]
    errors = np.where(weight, predicted - px, 0.0)
    jacobian = np.where(weight[:, :, None], by_point @ by_motion, 0.0)
    return errors.ravel(), jacobian.reshape(-1, 6)
