"""Tracks that have ended, or fill the window: they constrain the clones, and are not kept.

The point is estimated from all its views and then eliminated (the projection on its left null space, in
information form); what remains is a constraint between the poses alone.
Source: Mourikis and Roumeliotis, A Multi-State Constraint Kalman Filter, ICRA 2007, section III-D.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mapstream.operators.odometry.visual.sightings import Grouped
from mapstream.operators.odometry.visual.triangulation import (
    Points,
    by_pose,
    gains_at,
    triangulate,
)
from mapstream.operators.odometry.visual_inertial.state import NUM_INERTIAL, FilterState
from mapstream.streams.arrays import FloatArray, IntArray

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Constraints:
    """What F points say of K clones, C = 6 K columns, and of themselves."""

    keys: IntArray  # (F,)
    points: Points
    information: FloatArray  # (F, C, C) H^T H without the point
    vector: FloatArray  # (F, C) H^T r without the point
    accepted: BoolArray  # (F,)
    point_by_state: FloatArray  # (F, 3, C) how the points' errors follow those of the clones
    point_covariance: FloatArray  # (F, 3, 3) of the points, were the clones exact
    point_shift: FloatArray  # (F, 3) from where they were triangulated to where they fit best

    @property
    def total(self) -> tuple[FloatArray, FloatArray]:
        return self.information[self.accepted].sum(0), self.vector[self.accepted].sum(0)


def constraints(group: Grouped, state: FilterState) -> Constraints:
    """Return what points say of the clones, those that contradict the state marked as refused."""
    points = triangulate(group.views)
    residuals, gains = gains_at(group.views, points.positions)
    by_clone = by_pose(gains, points.positions[:, None])
    num_clones = len(state.clone_ids)
    (num, most), size = group.images.shape, residuals.shape[2]
    spread = np.zeros((num, most, size, num_clones, 6))
    f, m = np.nonzero(group.images >= 0)
    spread[f, m, :, group.images[f, m]] = by_clone[f, m]
    H = spread.reshape(num, size * most, 6 * num_clones)
    of_point = (gains @ points.axes[:, None]).reshape(num, size * most, 3)
    r = -residuals.reshape(num, size * most)
    Pt = np.swapaxes(of_point, 1, 2)
    C = np.linalg.inv(Pt @ of_point + 1e-9 * np.eye(3))
    follow = -C @ (Pt @ H)
    shift = (C @ (Pt @ r[..., None]))[..., 0]
    left_H = H + of_point @ follow  # what no shift of the point explains
    left_r = r - (of_point @ shift[..., None])[..., 0]
    accepted = _believed(state, left_H, left_r, group.views.freedom)
    accepted &= _seen_ahead(group, points.positions)
    axes = points.axes
    return Constraints(
        group.keys,
        points,
        np.swapaxes(left_H, 1, 2) @ left_H,
        np.einsum("fij,fi->fj", left_H, left_r),
        accepted,
        axes @ follow,
        axes @ C @ np.swapaxes(axes, 1, 2),
        (axes @ shift[..., None])[..., 0],
    )


def _believed(
    state: FilterState, H: FloatArray, residuals: FloatArray, freedom: IntArray
) -> BoolArray:
    """Return which residuals (F, M) are as small as their covariance says (Mahalanobis, 95 %)."""
    at = slice(NUM_INERTIAL, state.first_point_column)
    S = H @ state.covariance[at, at] @ np.swapaxes(H, 1, 2) + np.eye(H.shape[1])
    distance = np.einsum("fi,fi->f", residuals, np.linalg.solve(S, residuals[..., None])[..., 0])
    return np.asarray((freedom > 0) & (distance < chi2_limit(freedom)))


def _seen_ahead(group: Grouped, positions: FloatArray) -> BoolArray:
    """Return which points lie before all cameras that saw them, as far as the first can tell."""
    towards = positions - group.views.centres[:, 0]
    return np.asarray(np.einsum("fi,fi->f", towards, group.views.first) > 0)


def chi2_limit(freedom: IntArray) -> FloatArray:
    """Return the 95th percentile of chi squared (Wilson and Hilferty, 1931)."""
    k = np.maximum(np.asarray(freedom, dtype=np.float64), 1)
    return np.asarray(k * (1 - 2 / (9 * k) + 1.6449 * np.sqrt(2 / (9 * k))) ** 3)
