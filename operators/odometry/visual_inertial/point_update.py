"""Points that are tracked for longer than the window: they are part of the state, and tie it to the past.

Their derivatives are taken where each began (first estimates), so that turning all about gravity stays unobserved.
Source: Li and Mourikis, Optimization-based Estimator Design for Vision-Aided Inertial Navigation, RSS 2012;
Huang, Mourikis and Roumeliotis, Observability-based Rules for Consistent EKF SLAM, IJRR 2010.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.odometry.visual.sightings import Sightings, grouped
from mapstream.operators.odometry.visual.triangulation import by_pose, gains_at
from mapstream.operators.odometry.visual_inertial.feature_update import Constraints, chi2_limit
from mapstream.operators.odometry.visual_inertial.state import NUM_INERTIAL, FilterState
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

_MOST_RELATIVE_SIGMA = 0.3  # of a distance: what is less certain has no linear error yet


@dataclass(frozen=True, slots=True, eq=False)
class PointUpdate:
    """What the keypoints of known points say, in columns of the newest clone and of the points."""

    columns: IntArray  # (J,)
    information: FloatArray  # (J, J)
    vector: FloatArray  # (J,)
    refused: BoolArray  # (L,) points whose keypoints contradict the state


def point_update(sightings: Sightings, state: FilterState) -> PointUpdate:
    """Return what the keypoints of now say of points in the state; they are of the newest clone."""
    first = state.first_point_column
    pose = state.clone_columns(-1)
    columns = np.r_[pose, first : first + 3 * len(state.keys)]
    refused = np.zeros(len(state.keys), bool)
    information, vector = np.zeros((len(columns),) * 2), np.zeros(len(columns))
    if len(sightings) == 0:
        return PointUpdate(columns, information, vector, refused)
    group = grouped(sightings, state.clone_ids, state.clone_R, state.clone_p)
    by_key = np.argsort(state.keys)
    rows = by_key[np.searchsorted(state.keys, group.keys, sorter=by_key)]
    residuals, gains = gains_at(group.views, state.points[rows])
    by_clone = by_pose(gains, state.first_points[rows][:, None])
    (num, most), size = group.images.shape, residuals.shape[2]
    H = np.concatenate([by_clone, gains], axis=3).reshape(num, size * most, 9)
    r = -residuals.reshape(num, size * most)
    own = np.arange(3) + first + 3 * rows[:, None]
    at = np.concatenate([np.tile(np.arange(pose.start, pose.stop), (num, 1)), own], axis=1)
    P = state.covariance[at[:, :, None], at[:, None, :]]
    S = H @ P @ np.swapaxes(H, 1, 2) + np.eye(size * most)
    distance = np.einsum("fi,fi->f", r, np.linalg.solve(S, r[..., None])[..., 0])
    good = distance < chi2_limit(group.views.freedom + 3)
    refused[rows[~good]] = True
    for k in np.flatnonzero(good):
        place = np.r_[0:6, 6 + 3 * rows[k] : 9 + 3 * rows[k]]
        information[np.ix_(place, place)] += H[k].T @ H[k]
        vector[place] += H[k].T @ r[k]
    return PointUpdate(columns, information, vector, refused)


def begin_points(
    found: Constraints, state: FilterState, wanted: BoolArray, correction: FloatArray
) -> None:
    """Take points (F,) into the state whose constraints were just used.

    Args:
        found: The constraints, linearised before the update.
        state: After the update.
        wanted: (F,)
        correction: (C,) by which the update moved the clones.
    """
    clones = slice(NUM_INERTIAL, state.first_point_column)
    for k in np.flatnonzero(wanted):
        follow = found.found.point_by_poses[k]
        by_state = np.zeros((3, len(state.covariance)))
        by_state[:, clones] = follow
        position = (
            found.found.points.positions[k] + found.found.point_shift[k] + follow @ correction
        )
        root = found.found.point_roots[k]
        state.add_point(int(found.keys[k]), position, by_state, root @ root.T)


def is_certain(found: Constraints) -> BoolArray:
    """Return which points (F,) have distances that are certain enough to be kept."""
    points = found.found.points
    return np.asarray(points.sigmas < _MOST_RELATIVE_SIGMA * points.inverse_distances)
