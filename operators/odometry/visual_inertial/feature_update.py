"""Tracks that have ended, or fill the window: they constrain the clones, and are not kept.

The point is estimated from all its views and then eliminated; what remains is a constraint between the poses.
Source: Mourikis and Roumeliotis, A Multi-State Constraint Kalman Filter, ICRA 2007, section III-D.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.odometry.visual.elimination import Eliminated, eliminate
from mapstream.operators.odometry.visual.sightings import Grouped
from mapstream.operators.odometry.visual_inertial.state import NUM_INERTIAL, FilterState
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Constraints:
    """What F points say of K clones, and which are believed."""

    keys: IntArray  # (F,)
    found: Eliminated
    accepted: BoolArray  # (F,)

    @property
    def total(self) -> tuple[FloatArray, FloatArray]:
        """Return H^T H (C, C) and H^T r (C,) of those that are believed."""
        H = self.found.H[self.accepted].reshape(-1, self.found.H.shape[2])
        return H.T @ H, H.T @ self.found.residuals[self.accepted].ravel()


def constraints(group: Grouped, state: FilterState) -> Constraints:
    """Return what points say of the clones; those that contradict the state are not believed."""
    found = eliminate(group, len(state.clone_ids))
    accepted = _fits(state, found.H, found.residuals, group.views.freedom)
    accepted &= _seen_ahead(group, found.points.positions)
    return Constraints(group.keys, found, accepted)


def _fits(state: FilterState, H: FloatArray, residuals: FloatArray, freedom: IntArray) -> BoolArray:
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
