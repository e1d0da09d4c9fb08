"""Points from the rays of many views, many points at once.

A point is its direction and its inverse distance from the view that saw it first, so that points too far for
their parallax have a well-posed estimate as well: the inverse distance is then small and uncertain.
Source: Mourikis and Roumeliotis, A Multi-State Constraint Kalman Filter, ICRA 2007, appendix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import hat

_STEPS = 4
_LEAST_INVERSE = 1e-4  # [1/m]: what is farther than 10 km is at 10 km


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Who saw each of F points, and where: at most M views of a point, unused ones with weight zero.

    All in one frame, the world. `rows` is the weight of `rays.Rays` turned into it: a point f has the
    residual rows @ (f - centres) / |f - centres|.
    """

    rows: FloatArray  # (F, M, 2, 3)
    centres: FloatArray  # (F, M, 3) [m]; of unused views that of the first one
    first: FloatArray  # (F, 3) unit direction in which the first view sees the point
    counts: IntArray  # (F,)

    def chosen(self, which: FloatArray | IntArray) -> Views:
        """Return those of some points."""
        return Views(self.rows[which], self.centres[which], self.first[which], self.counts[which])


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
    to_first = views.centres[:, :1] - views.centres  # (F, M, 3)
    direction = views.first
    across = _across(direction)
    along = np.einsum("fmij,fmj->fmi", views.rows, to_first)
    ahead = np.einsum("fmij,fj->fmi", views.rows, direction)
    inverse = -(along * ahead).sum((1, 2)) / np.maximum((along**2).sum((1, 2)), 1e-12)
    inverse = np.maximum(inverse, _LEAST_INVERSE)
    for _ in range(_STEPS):
        residuals, gains = _linearized(views, direction, inverse, to_first)
        jacobian = np.concatenate(
            [gains @ across[:, None], (gains @ to_first[..., None])], axis=3
        )  # (F, M, 2, 3) by two angles and the inverse distance
        N = np.einsum("fmia,fmib->fab", jacobian, jacobian) + 1e-9 * np.eye(3)
        step = np.linalg.solve(N, -np.einsum("fmia,fmi->fa", jacobian, residuals)[..., None])
        direction = direction + (across @ step[:, :2])[..., 0]
        inverse = np.maximum(inverse + step[:, 2, 0], _LEAST_INVERSE)
    residuals, gains = _linearized(views, direction, inverse, to_first)
    length = np.linalg.norm(direction, axis=1)
    distance = length / inverse
    positions = views.centres[:, 0] + direction / inverse[:, None]
    axes = np.concatenate(
        [across * distance[:, None, None], (direction * (distance / inverse)[:, None])[..., None]],
        axis=2,
    )
    jacobian = np.concatenate([gains @ across[:, None], gains @ to_first[..., None]], axis=3)
    N = np.einsum("fmia,fmib->fab", jacobian, jacobian) + 1e-9 * np.eye(3)
    sigmas = np.sqrt(np.linalg.inv(N)[:, 2, 2]) / length
    return Points(
        positions, inverse / length, sigmas, axes, (residuals**2).sum((1, 2)), views.counts
    )


def gains_at(views: Views, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return residuals (F, M, 2) of points (F, 3), and how they change with the points (F, M, 2, 3)."""
    return _gains(views.rows, positions[:, None] - views.centres)


def by_pose(gains: FloatArray, positions: FloatArray) -> FloatArray:
    """Return how residuals change with the poses of their views, (..., 2, 6), rotation first.

    The poses are perturbed on the left, in the world: T = exp(xi) T_estimate.
    """
    turned = gains @ hat(positions)
    return np.concatenate([turned, -gains], axis=-1)


def _linearized(
    views: Views, direction: FloatArray, inverse: FloatArray, to_first: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals, and their derivatives by the direction and by the inverse distance times `to_first`."""
    seen = direction[:, None] + inverse[:, None, None] * to_first
    return _gains(views.rows, seen)


def _gains(rows: FloatArray, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
    length = np.maximum(np.linalg.norm(seen, axis=-1), 1e-9)
    unit = seen / length[..., None]
    residuals = np.einsum("...ij,...j->...i", rows, unit)
    gains = (rows - residuals[..., None] * unit[..., None, :]) / length[..., None, None]
    return residuals, gains


def _across(direction: FloatArray) -> FloatArray:
    """Return two directions (F, 3, 2) perpendicular to each of (F, 3)."""
    helper = np.eye(3)[np.argmin(np.abs(direction), axis=1)]
    one = np.cross(direction, helper)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return np.stack([one, np.cross(direction, one)], axis=2)
