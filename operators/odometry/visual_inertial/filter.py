"""A multi-state constraint Kalman filter with points: one step per n-frame.

Source: Mourikis and Roumeliotis, A Multi-State Constraint Kalman Filter for Vision-aided Inertial
Navigation, ICRA 2007; Geneva et al., OpenVINS: A Research Platform for Visual-Inertial Estimation, ICRA 2020.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.odometry.visual.rays import Rays
from mapstream.operators.odometry.visual.sightings import Sightings, grouped
from mapstream.operators.odometry.visual_inertial.feature_update import Constraints, constraints
from mapstream.operators.odometry.visual_inertial.point_update import (
    PointUpdate,
    begin_points,
    is_certain,
    point_update,
)
from mapstream.operators.odometry.visual_inertial.propagation import Motion, propagate
from mapstream.operators.odometry.visual_inertial.standstill import Standstill, stand
from mapstream.operators.odometry.visual_inertial.state import (
    NUM_INERTIAL,
    FilterState,
    compressed,
    update,
)
from mapstream.operators.odometry.visual_inertial.window import complete
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3, invert


@dataclass(frozen=True, slots=True)
class FilterLimits:
    """How much the filter keeps and looks at."""

    num_clones: int = 11
    num_points: int = 40
    num_tracks: int = 60  # that are used in one step


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """What one n-frame did."""

    covariance: FloatArray  # (6, 6) of the IMU's motion since the last one
    num_used: int  # tracks that were believed
    num_refused: int
    num_followed: int  # tracks that were seen before
    is_standing: bool


class Filter:
    """Carries a state from n-frame to n-frame."""

    def __init__(
        self, state: FilterState, imu: ImuQuality, T_base_imu: SE3, limits: FilterLimits
    ) -> None:
        self.state = state
        self._imu = imu
        self._T_imu_base = T_base_imu.inverse().matrix
        self._limits = limits
        self._sightings = Sightings.none()
        self._standstill = Standstill(is_standing=state.is_standing)
        self._standing_clone: int | None = None  # of the last n-frame, if it stood then
        self._resting_R: FloatArray | None = None  # the attitude in which it came to rest
        self._next_id = 0
        self._last_keys: IntArray = np.empty(0, np.int64)

    def step(self, rays: Rays, motion: Motion) -> Step:
        """Go on to the n-frame at the end of `motion`; of the first one the motion has no length."""
        state = self.state
        known_before = _last_clone(state)
        has_passed = motion.stamps_ns[-1] > state.stamp_ns
        if has_passed:
            propagate(state, motion, self._imu)
        is_standing = self._standstill.judge(state.stamp_ns, rays, motion)
        state.is_standing = is_standing
        if not is_standing:
            self._resting_R = None
        elif has_passed:
            self._resting_R = state.R if self._resting_R is None else self._resting_R
            stand(state, motion, self._imu, self._resting_R)
        clone_id = self._next_id
        self._next_id += 1
        state.clone(clone_id)
        seen = Sightings.of(rays, clone_id, self._T_imu_base)
        is_point = np.isin(seen.keys, state.keys)
        self._sightings = self._sightings.joined(seen.chosen(~is_point))
        num_used = num_refused = 0
        if not is_standing:
            num_used, num_refused = self._use(rays.keys, seen.chosen(is_point))
        state.forget_points(~np.isin(state.keys, rays.keys))
        covariance = _step_covariance(state, known_before)
        self._forget(clone_id, is_standing=is_standing)
        num_followed = len(np.intersect1d(rays.keys, self._last_keys))
        self._last_keys = rays.keys
        return Step(covariance, num_used, num_refused, num_followed, is_standing)

    def _use(self, keys_now: IntArray, of_points: Sightings) -> tuple[int, int]:
        """Update with complete tracks and with points; return how many were believed, and how many not."""
        state, limits = self.state, self._limits
        is_full = len(state.clone_ids) >= limits.num_clones
        oldest_id = state.clone_ids[0] if is_full else None
        chosen, spent = complete(self._sightings, keys_now, oldest_id, limits.num_tracks)
        used = self._sightings.chosen(np.isin(self._sightings.keys, chosen))
        group = grouped(used, state.clone_ids, state.clone_R, state.clone_p)
        found = constraints(group, state)
        known = point_update(of_points, state)
        correction = _update(state, found, known)
        state.forget_points(known.refused)
        begins = found.accepted & is_certain(found) & np.isin(found.keys, keys_now)
        begins &= np.cumsum(begins) <= max(0, limits.num_points - len(state.keys))
        begin_points(found, state, begins, correction)
        self._sightings = self._sightings.chosen(~np.isin(self._sightings.keys, spent))
        num_refused = int(known.refused.sum() + (~found.accepted).sum())
        num_judged = len(np.unique(of_points.keys)) + len(found.keys)
        return num_judged - num_refused, num_refused

    def _forget(self, clone_id: int, *, is_standing: bool) -> None:
        """Drop the oldest clone of a full window; and of a robot that stands all but the last."""
        state = self.state
        gone = state.clone_ids[: max(0, len(state.clone_ids) - self._limits.num_clones + 1)]
        if is_standing and self._standing_clone is not None:
            gone = np.append(gone, self._standing_clone)
        self._standing_clone = clone_id if is_standing else None
        state.forget_clones(gone)
        kept = ~np.isin(self._sightings.images, gone)
        self._sightings = self._sightings.chosen(kept)


def _update(state: FilterState, found: Constraints, known: PointUpdate) -> FloatArray:
    """Take all measurements of an n-frame in at once; return how the clones (C,) were moved."""
    num = len(state.covariance) - NUM_INERTIAL
    information, vector = np.zeros((num, num)), np.zeros(num)
    of_clones, vector_of_clones = found.total
    num_clones = len(of_clones)
    information[:num_clones, :num_clones] = of_clones
    vector[:num_clones] = vector_of_clones
    at = known.columns - NUM_INERTIAL
    information[np.ix_(at, at)] += known.information
    vector[at] += known.vector
    columns = np.arange(NUM_INERTIAL, NUM_INERTIAL + num)
    error = update(state, columns, *compressed(information, vector))
    return error[NUM_INERTIAL : NUM_INERTIAL + num_clones]


def _last_clone(state: FilterState) -> FloatArray:
    """Return the covariance (6, 6) of the last n-frame's pose; zero before the first."""
    if len(state.clone_ids) == 0:
        return np.zeros((6, 6))
    last = state.clone_columns(-1)
    return np.array(state.covariance[last, last])


def _step_covariance(state: FilterState, known_before: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of the motion from the last reported pose to this one, perturbed on the right.

    The last pose was reported before this n-frame corrected it. The correction is independent of the errors that are
    left, so that its covariance, what that pose's covariance shrank by, adds to that between the clones.
    """
    if len(state.clone_ids) < 2:
        return np.zeros((6, 6))
    after, before = state.clone_columns(-1), state.clone_columns(-2)
    P = state.covariance
    cross = P[after, before]
    difference = P[after, after] + known_before - cross - cross.T
    local = SE3(invert(state.T_odom_imu.matrix)).adjoint()
    return np.asarray(local @ difference @ local.T)
