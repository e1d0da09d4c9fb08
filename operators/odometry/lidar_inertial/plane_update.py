"""A scan against the map: an iterated Kalman update by the distances of points from planes.

Directions that the planes do not hold get no information at all; there the IMU alone says where the robot is.
Source: Xu et al., FAST-LIO2, T-RO 2022, section IV-D; Zhang, Kaess, Singh, On degeneracy of optimization-based
state estimation problems, ICRA 2016.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.lidar.observability import Observability, observability_of_planes
from mapstream.operators.odometry.lidar_inertial.point_map import PointMap
from mapstream.operators.odometry.lidar_inertial.state import PLACE, POSE, SIZE, LidarInertialState
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import symmetric

_ITERATIONS = 10
_DONE_RAD, _DONE_M = 2e-4, 5e-4
_NEAR_M, _NEAR_PER_ROOT_M = 0.1, 0.05  # how far from its plane a point may be, more with range
_FAR_M = 1.0  # and at most so much more for an unsure prior, half of it at each next iteration
_MEDIAN_TO_SIGMA = 1.4826
_LEAST_SIGMA_M = 0.01
_KERNEL = 3.0  # sigmas, beyond which a point counts little (Cauchy)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A state that a scan was taken into, and how well the scan fits."""

    state: LidarInertialState
    seen: Observability  # of the pose, tangent of the IMU's pose perturbed on the right
    matched_fraction: float  # of the points, those that lie on a plane of the map
    rmse_m: float  # of these, across their planes


def fit(prior: LidarInertialState, points: FloatArray, surroundings: PointMap) -> Fit:
    """Take a scan into the state.

    Args:
        prior: At the scan's end; it is not changed.
        points: (N, 3) in the IMU's frame at that time, free of motion distortion [m].
        surroundings: The map.
    """
    known = np.linalg.inv(prior.covariance)
    error = np.zeros(SIZE)
    sigma_m = float(np.sqrt(np.diagonal(prior.covariance)[PLACE].max()))
    far_m = min(2 * sigma_m, _FAR_M)
    rows, state = _rows(prior, points, surroundings, far_m), prior
    for iteration in range(_ITERATIONS):
        if iteration:
            rows = _rows(state, points, surroundings, far_m / 2**iteration)
        whole, towards = known.copy(), np.zeros(SIZE)
        whole[POSE, POSE] += rows.information
        towards[POSE] = rows.vector + rows.information @ error[POSE]
        covariance = symmetric(np.linalg.inv(whole))
        moved = np.abs(covariance[POSE] @ towards - error[POSE])
        error = covariance @ towards
        state = prior.corrected(error, covariance)
        is_done = moved[:3].max() < _DONE_RAD and moved[3:].max() < _DONE_M
        if is_done and far_m / 2**iteration < _NEAR_M:
            break
    return Fit(state, rows.seen, rows.matched_fraction, rows.rmse_m)


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """What all points together say at one linearisation."""

    seen: Observability
    information: FloatArray  # (6, 6) of the state's error of the pose
    vector: FloatArray  # (6,) where to they pull it, in units of information
    matched_fraction: float
    rmse_m: float


def _rows(
    state: LidarInertialState, points: FloatArray, surroundings: PointMap, far_m: float
) -> _Rows:
    places = points @ state.R.T + state.p
    planes = surroundings.planes(places, far_m)
    across = np.einsum("ij,ij->i", planes.normals, places - planes.centres)
    near_m = far_m + _NEAR_M + _NEAR_PER_ROOT_M * np.sqrt(np.linalg.norm(points, axis=1))
    used = planes.is_flat & (np.abs(across) < near_m)
    points, normals, across = points[used], planes.normals[used] @ state.R, across[used]
    rmse_m = float(np.median(np.abs(across)) * _MEDIAN_TO_SIGMA) if used.any() else np.inf
    weights = 1 / (1 + (across / (_KERNEL * max(rmse_m, _LEAST_SIGMA_M))) ** 2)
    seen = observability_of_planes(points, normals, rmse_m, weights)
    pull = np.hstack([np.cross(points, normals), normals]).T @ (weights * -across)
    pull = seen.seen_part.T @ pull / seen.variance
    to_body = np.eye(6)
    to_body[3:, 3:] = state.R.T  # the state's place is in the odom frame, the rows' in the IMU's
    information = to_body.T @ seen.information @ to_body
    return _Rows(seen, information, to_body.T @ pull, float(used.mean()), rmse_m)
