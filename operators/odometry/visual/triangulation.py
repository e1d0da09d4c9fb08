"""Points from the rays of many views, many points at once.

A point is its direction and its inverse distance from the view that saw it first, so that points too far for
their parallax have a well-posed estimate as well: the inverse distance is then small and uncertain.
Source: Mourikis and Roumeliotis, A Multi-State Constraint Kalman Filter, ICRA 2007, appendix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.odometry.visual.sightings import Views
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import hat

_STEPS = 4
_LEAST_INVERSE = 1e-4  # [1/m]: what is farther than 10 km is at 10 km


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Triangulated points, in the frame of the views."""

    positions: FloatArray  # (F, 3) [m]
    inverse_distances: FloatArray  # (F,) [1/m] from the first view
    sigmas: FloatArray  # (F,) of the inverse distances
    axes: FloatArray  # (F, 3, 3) columns: steps of the position, two across and one along, well scaled
    cost: FloatArray  # (F,) sum of squared residuals
    counts: IntArray  # (F,) views


def triangulate(views: Views) -> Points:
    """Return the points that fit their views best, by Gauss and Newton from the best distance on the first ray."""
    direction, inverse = views.first, _first_inverse(views)
    for _ in range(_STEPS):
        positions, axes = _placed(views, direction, inverse)
        residuals, N, jacobian = _normal(views, positions, axes)
        step = np.linalg.solve(N, -np.einsum("fmia,fmi->fa", jacobian, residuals)[..., None])
        direction = direction + (axes[:, :, :2] @ step[:, :2])[..., 0] * inverse[:, None]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        inverse = np.maximum(inverse - step[:, 2, 0], _LEAST_INVERSE)
    positions, axes = _placed(views, direction, inverse)
    residuals, N, _ = _normal(views, positions, axes)
    sigmas = np.sqrt(np.linalg.inv(N)[:, 2, 2])
    return Points(positions, inverse, sigmas, axes, (residuals**2).sum((1, 2)), views.counts)


def gains_at(views: Views, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return residuals (F, M, 2) of points (F, 3), and how they change with the points (F, M, 2, 3).

    Where distances were measured there is a third row.
    """
    seen = positions[:, None] - views.centres
    length = np.maximum(np.linalg.norm(seen, axis=-1), 1e-9)
    unit = seen / length[..., None]
    residuals = np.einsum("...ij,...j->...i", views.rows, unit)
    gains = (views.rows - residuals[..., None] * unit[..., None, :]) / length[..., None, None]
    if views.distances is None or views.distance_weights is None:
        return residuals, gains
    weights = views.distance_weights
    farther = (length - views.distances) * weights
    along = (unit * weights[..., None])[..., None, :]
    return (
        np.concatenate([residuals, farther[..., None]], axis=-1),
        np.concatenate([gains, along], axis=-2),
    )


def by_pose(gains: FloatArray, positions: FloatArray) -> FloatArray:
    """Return how residuals change with the poses of their views, (..., 6), rotation first.

    The poses are perturbed on the left, in the world: T = exp(xi) T_estimate.
    """
    turned = gains @ hat(positions)
    return np.concatenate([turned, -gains], axis=-1)


def _first_inverse(views: Views) -> FloatArray:
    """Return the inverse distance (F,) along the first ray: measured there, or best for the other rays."""
    to_first = views.centres[:, :1] - views.centres  # (F, M, 3)
    along = np.einsum("fmij,fmj->fmi", views.rows, to_first)
    ahead = np.einsum("fmij,fj->fmi", views.rows, views.first)
    inverse = -(along * ahead).sum((1, 2)) / np.maximum((along**2).sum((1, 2)), 1e-12)
    if views.distances is not None and views.distance_weights is not None:
        measured = views.distance_weights[:, 0] > 0
        inverse = np.where(measured, 1 / np.maximum(views.distances[:, 0], 1e-3), inverse)
    return np.asarray(np.maximum(inverse, _LEAST_INVERSE))


def _placed(
    views: Views, direction: FloatArray, inverse: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return positions (F, 3), and the steps (F, 3, 3) of two angles and the inverse distance."""
    away = direction / inverse[:, None]
    across = _across(direction) / inverse[:, None, None]
    along = (away / inverse[:, None])[..., None]
    return views.centres[:, 0] + away, np.concatenate([across, along], axis=2)


def _normal(
    views: Views, positions: FloatArray, axes: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    residuals, gains = gains_at(views, positions)
    jacobian = gains @ axes[:, None]
    N = np.einsum("fmia,fmib->fab", jacobian, jacobian) + 1e-9 * np.eye(3)
    return residuals, N, jacobian


def _across(direction: FloatArray) -> FloatArray:
    """Return two directions (F, 3, 2) perpendicular to each of (F, 3)."""
    helper = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    one = np.cross(direction, helper)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return np.stack([one, np.cross(direction, one)], axis=2)
