"""The last keyframes and the points they saw: what a camera rig finds its pose against.

Poses and points are refined together whenever a keyframe comes (windowed bundle adjustment, the points
eliminated); the oldest poses stay where they are.
Source: Engels, Stewenius and Nister, Bundle Adjustment Rules, PCV 2006.
"""

from __future__ import annotations

import numpy as np

from mapstream.operators.odometry.visual.elimination import eliminate
from mapstream.operators.odometry.visual.sightings import Grouped, Sightings, grouped
from mapstream.operators.odometry.visual.triangulation import gains_at
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import se3_exp, straightened

_STEPS = 5
_FAULT = 2.0  # times the expected sum of squares, from which on a point counts little (Cauchy)
_VAGUE_PER_M = 0.05  # of an inverse distance: a point so uncertain tells nothing yet
_WORST_SIGMAS = 5.0  # a keypoint farther from its point is false
_NUM_FIXED = 2  # poses that stay, so that the window goes on from what was said
_MOST_REFINED = 300  # points
_STILL = 1e-5  # a step so small is the last one


class LocalMap:
    """Keyframes in their order, and points by key.

    Args:
        num_keyframes: So many are kept.
    """

    def __init__(self, num_keyframes: int) -> None:
        self._most = num_keyframes
        self._sightings = Sightings.none()
        self._numbers: IntArray = np.empty(0, np.int64)
        self._poses: FloatArray = np.empty((0, 4, 4))
        self._next = 0
        self.keys: IntArray = np.empty(0, np.int64)  # (P,) sorted
        self.positions: FloatArray = np.empty((0, 3))  # (P, 3)
        self.roots: FloatArray = np.empty((0, 3, 3))  # (P, 3, 3) of the points' covariances [m]

    @property
    def T_world_base(self) -> FloatArray:
        """Return the pose (4, 4) of the newest keyframe."""
        return np.asarray(self._poses[-1])

    def add(self, sightings: Sightings, T_world_base: FloatArray) -> None:
        """Take an n-frame at a pose as keyframe, and refine the window."""
        number = self._next
        self._next += 1
        sightings = sightings.chosen(np.arange(len(sightings)))
        sightings.images = np.full(len(sightings), number)
        self._sightings = self._sightings.joined(sightings)
        self._numbers = np.append(self._numbers, number)
        self._poses = np.concatenate([self._poses, T_world_base[None]])
        if len(self._numbers) > self._most:
            self._sightings = self._sightings.chosen(self._sightings.images != self._numbers[0])
            self._numbers, self._poses = self._numbers[1:], self._poses[1:]
        self._refine()

    def found(self, keys: IntArray) -> IntArray:
        """Return the rows (N,) of the points with these keys; -1: none."""
        if len(self.keys) == 0:
            return np.full(len(keys), -1)
        rows = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[rows] == keys, rows, -1)

    def _grouped(self, sightings: Sightings) -> Grouped:
        return grouped(sightings, self._numbers, self._poses[:, :3, :3], self._poses[:, :3, 3])

    def _shared(self) -> Sightings:
        """Return the sightings of points that several keyframes saw, those that most saw if they are many."""
        pairs = np.unique(np.stack([self._sightings.keys, self._sightings.images]), axis=1)
        keys, counts = np.unique(pairs[0], return_counts=True)
        order = np.lexsort((keys, -counts))[:_MOST_REFINED]
        return self._sightings.chosen(np.isin(self._sightings.keys, keys[order[counts[order] > 1]]))

    def _refine(self) -> None:
        num = len(self._numbers)
        fixed = min(_NUM_FIXED, num - 1)
        shared = self._shared()
        for _ in range(_STEPS if len(shared) else 0):
            group = self._grouped(shared)
            found = eliminate(group, num)
            excess = found.points.cost / np.maximum(group.views.freedom, 1)
            root = np.sqrt(1 / (1 + excess / _FAULT))[:, None]
            H = (found.H[:, :, 6 * fixed :] * root[..., None]).reshape(-1, 6 * (num - fixed))
            r = (found.residuals * root).ravel()
            step = np.linalg.solve(H.T @ H + 1e-6 * np.eye(H.shape[1]), H.T @ r).reshape(-1, 6)
            self._poses[fixed:] = straightened(se3_exp(step) @ self._poses[fixed:])
            if np.linalg.norm(step) < _STILL:
                break
        self._settle()

    def _settle(self) -> None:
        """Place the points once more, and drop keypoints that are far from theirs."""
        group = self._grouped(self._sightings)
        if len(group.keys) == 0:
            self.keys, self.positions = np.empty(0, np.int64), np.empty((0, 3))
            self.roots = np.empty((0, 3, 3))
            return
        found = eliminate(group, len(self._numbers))
        points = found.points
        known = points.sigmas < _VAGUE_PER_M + 0.5 * points.inverse_distances
        self.keys, self.positions = group.keys[known], points.positions[known]
        self.roots = found.point_roots[known]
        residuals, _ = gains_at(group.views, points.positions)
        worst = np.abs(residuals).max(axis=2)  # (F, M)
        is_false = (worst > _WORST_SIGMAS) & (group.images >= 0)
        if is_false.any():
            f, m = np.nonzero(is_false)
            pairs = set(
                zip(group.keys[f].tolist(), self._numbers[group.images[f, m]].tolist(), strict=True)
            )
            mine = zip(self._sightings.keys.tolist(), self._sightings.images.tolist(), strict=True)
            self._sightings = self._sightings.chosen(np.array([pair not in pairs for pair in mine]))
