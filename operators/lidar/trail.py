"""The keyframes of one mission so far, where they are taken to be now, and which of them are places revisited."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapCorrection, Submap


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach:
    """How far away, in space and along the path, a place may be to count as seen before."""

    min_keyframes: int  # between the two
    min_path_m: float  # travelled between the two
    distance_m: float  # at most, without drift
    drift: float  # and so much more per metre travelled since a loop was closed


@dataclass(frozen=True, slots=True)
class Place:
    """A keyframe near a later one."""

    index: int
    distance_m: float
    reach_m: float  # the distance that would have been allowed


class Trail:
    """Keyframes in order, with the latest poses that the optimizer gave."""

    def __init__(self) -> None:
        self.stamps_ns: IntArray = np.empty(0, dtype=np.int64)
        self._poses: FloatArray = np.empty((0, 4, 4))  # T_mission_base
        self._path_m: FloatArray = np.empty(0)  # travelled until here
        self._poses_odom: FloatArray = np.empty((0, 4, 4))
        self._T_mission_odom = SE3.identity()
        self._closed_m = (
            self._corrected_m
        ) = -np.inf  # travelled until a loop closed, and was solved

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def correct(self, correction: MapCorrection) -> None:
        """Take over the poses of all keyframes that the correction knows."""
        at = np.searchsorted(correction.stamps_ns, self.stamps_ns)
        known = np.append(correction.stamps_ns, -1)[at] == self.stamps_ns
        self._poses[known] = correction.T_mission_base[at[known]]
        self._T_mission_odom = correction.T_mission_odom
        self._corrected_m = self._closed_m

    def close(self, index: int) -> None:
        """Note that a loop closed here: with the next correction the drift until here is gone."""
        self._closed_m = self._path_m[index]

    def extend(self, submap: Submap) -> range:
        """Append a submap's keyframes; return the indices of those that are new."""
        newest_ns = self.stamps_ns[-1] if len(self) else None
        frames = [f for f in submap.keyframes if newest_ns is None or f.stamp_ns > newest_ns]
        odom = np.array([f.odometry.T_odom_base.matrix for f in frames]).reshape(-1, 4, 4)
        first = len(self)
        self.stamps_ns = np.append(self.stamps_ns, [f.stamp_ns for f in frames]).astype(np.int64)
        self._poses = np.concatenate([self._poses, self._T_mission_odom.matrix @ odom])
        self._poses_odom = np.concatenate([self._poses_odom, odom])
        steps_m = np.linalg.norm(np.diff(self._poses_odom[:, :3, 3], axis=0), axis=1)
        self._path_m = np.concatenate([[0.0], np.cumsum(steps_m)])[: len(self)]
        return range(first, len(self))

    def pose(self, index: int) -> SE3:
        """Return T_mission_base of a keyframe as it is known now."""
        return SE3(self._poses[index])

    def path_m(self, index: int) -> float:
        """Return how far the base had travelled."""
        return float(self._path_m[index])

    def seen_before(self, index: int, reach: Reach) -> Place | None:
        """Return the closest keyframe far enough in the past, if it is within reach.

        Source: Trevor et al., OmniMapper, ICRA 2014, section IV-C1: the closest place that was observed far
        enough in the past so as to favour large loops.
        """
        num_past = index - reach.min_keyframes
        if num_past <= 0:
            return None
        travelled_m = self._path_m[index] - self._path_m[:num_past]
        shifts = self._poses[:num_past, :3, 3] - self._poses[index, :3, 3]
        distances_m = np.linalg.norm(shifts, axis=1)
        drifted_m = np.minimum(travelled_m, self._path_m[index] - self._corrected_m)
        reaches_m = reach.distance_m + reach.drift * drifted_m
        outside = (travelled_m < reach.min_path_m) | (distances_m > reaches_m)
        distances_m = np.where(outside, np.inf, distances_m)
        nearest = int(np.argmin(distances_m))
        if outside[nearest]:
            return None
        return Place(nearest, float(distances_m[nearest]), float(reaches_m[nearest]))
