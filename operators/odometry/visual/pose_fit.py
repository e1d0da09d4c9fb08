"""The pose of a camera rig from points that are known, each with its uncertainty.

A point whose distance is uncertain counts across its rays and little along them: a far point tells the
rotation, and no false translation.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mapstream.operators.odometry.visual.sightings import Sightings, grouped
from mapstream.operators.odometry.visual.triangulation import by_pose, gains_at
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import invert, se3_exp, straightened

_STEPS = 10
_FAULT = 2.0  # times the expected sum of squares, from which on a point counts little (Cauchy)
_INLIER = 6.0  # times it, beyond which a point does not belong
_RANSAC_PLANE = 0.01  # on the plane z = 1, about 5 px
_RANSAC_TRIALS = 300
_LEAST_FOR_RANSAC = 6


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """A pose and what it rests on."""

    T_world_base: FloatArray  # (4, 4)
    covariance: FloatArray  # (6, 6) perturbed on the left, in the world
    is_inlier: BoolArray  # (F,) of the points


def fit_pose(
    sightings: Sightings, positions: FloatArray, roots: FloatArray, T_world_base: FloatArray
) -> PoseFit:
    """Return the pose that fits the keypoints of one n-frame best, by Gauss and Newton with Cauchy's weights.

    Args:
        sightings: Of F points, seen from the base.
        positions: (F, 3) of the points, in the order of their keys [m].
        roots: (F, 3, 3) of their roots [m].
        T_world_base: (4, 4) where to begin.
    """
    T = T_world_base
    squares, freedom, N = _normal(sightings, positions, roots, T)[:3]
    for _ in range(_STEPS):
        squares, freedom, N, vector = _normal(sightings, positions, roots, T)
        step = np.linalg.solve(N, vector)
        T = straightened(se3_exp(step) @ T)
        if np.linalg.norm(step) < 1e-7:
            break
    return PoseFit(T, np.asarray(np.linalg.inv(N)), squares < _INLIER * freedom)


def search_pose(
    sightings: Sightings, positions: FloatArray, roots: FloatArray, *, seed: int
) -> PoseFit:
    """Return the pose without an idea where to begin: three points at a time, tried often, then refined.

    Raises:
        EstimationError: If too few points lie before the camera, or they do not agree.
    """
    keys, first = np.unique(sightings.keys, return_index=True)
    rays = sightings.rays[first]
    ahead = rays @ rays.mean(axis=0) > 0.2 * np.linalg.norm(rays.mean(axis=0))
    turn = _looking_along(rays.mean(axis=0))  # cv2 knows the plane z = 1 only
    rays = rays @ turn.T
    ahead &= rays[:, 2] > 0.1
    if ahead.sum() < _LEAST_FOR_RANSAC:
        raise EstimationError(f"{int(ahead.sum())} known points are in view, too few for a pose")
    cv2.setRNGSeed(seed % 2**31)
    is_found, rotation, translation, inliers = cv2.solvePnPRansac(
        positions[ahead],
        rays[ahead, :2] / rays[ahead, 2:],
        np.eye(3),
        None,
        iterationsCount=_RANSAC_TRIALS,
        reprojectionError=_RANSAC_PLANE,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not is_found or inliers is None:
        raise EstimationError(f"{int(ahead.sum())} known points are in view, and do not agree")
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3], T_camera_world[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    T_base_camera = np.eye(4)
    T_base_camera[:3, :3] = turn.T
    T_base_camera[:3, 3] = sightings.offsets[first].mean(axis=0)
    start = invert(T_base_camera @ T_camera_world)
    rows = np.flatnonzero(ahead)[inliers[:, 0]]
    among = np.isin(sightings.keys, keys[rows])
    near = fit_pose(sightings.chosen(among), positions[rows], roots[rows], start)
    return fit_pose(sightings, positions, roots, near.T_world_base)


def _normal(
    sightings: Sightings, positions: FloatArray, roots: FloatArray, T: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return squared residuals (F,) and their expected sums, and the weighted normal equations."""
    group = grouped(sightings, np.unique(sightings.images), T[None, :3, :3], T[None, :3, 3])
    residuals, gains = gains_at(group.views, positions)
    num, size = len(positions), residuals.shape[1] * residuals.shape[2]
    G, r = gains.reshape(num, size, 3), -residuals.reshape(num, size)
    spread = G @ roots
    S = spread @ np.swapaxes(spread, 1, 2) + np.eye(size)
    H = by_pose(gains, positions[:, None]).reshape(num, size, 6)
    weighted = np.linalg.solve(S, np.concatenate([H, r[..., None]], axis=2))
    squares = np.einsum("fi,fi->f", r, weighted[..., 6])
    freedom = (group.views.freedom + 3).astype(np.float64)
    w = 1 / (1 + squares / (_FAULT * freedom))
    N = np.einsum("fia,fib,f->ab", H, weighted[..., :6], w) + 1e-9 * np.eye(6)
    return squares, freedom, N, np.einsum("fia,fi,f->a", H, weighted[..., 6], w)


def _looking_along(direction: FloatArray) -> FloatArray:
    """Return a rotation (3, 3) that turns a direction to z."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
