"""The way of a robot in a map: odometry as it comes, fixes as they come late, and a pose for each moment."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

from mapstream.operators.places.drift import Drift, DriftConfig, Fix
from mapstream.operators.places.map_poses import MapPoses
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapPose, Odometry


class Following:
    """Holds odometry in the map by fixes of earlier moments.

    Args:
        config: What is believed of odometry and of fixes.
        late_ns: So long after its moment a fix may come.
    """

    def __init__(self, config: DriftConfig, late_ns: int) -> None:
        self._drift, self._late_ns = Drift(config), late_ns
        self._moves: list[Odometry] = []  # as far back as fixes may be late
        self._poses = MapPoses()

    @property
    def has_tracked(self) -> bool:
        return self._poses.has_tracked

    @property
    def is_lost(self) -> bool:
        return self._drift.is_lost

    def move(self, odometry: Odometry) -> None:
        """Follow the odometry."""
        self._moves.append(odometry)
        self._drift.move(odometry.T_odom_base)

    def T_map_base_at(self, stamp_ns: int) -> SE3 | None:
        """Return where the robot is taken to have been at a moment; None while it is lost."""
        T_map_odom = None if self.is_lost else self._drift.T_map_odom(self._moves[-1].stamp_ns)
        return None if T_map_odom is None else T_map_odom @ _at(self._moves, stamp_ns)

    def correct(self, stamp_ns: int, T_map_base: SE3, covariance: FloatArray) -> None:
        """Take in where the robot was found to be at a moment."""
        T_odom_base = _at(self._moves, stamp_ns)
        self._drift.correct(Fix(stamp_ns, T_map_base, covariance, T_odom_base))

    def pose(self, num_inliers: int, verdict: str) -> MapPose:
        """Return where the robot is at the newest odometry, after the fixes until then.

        Args:
            num_inliers: Of what was compared with the map since the pose before.
            verdict: On that.
        """
        odometry = self._moves[-1]
        while len(self._moves) > 1 and self._moves[1].stamp_ns <= odometry.stamp_ns - self._late_ns:
            del self._moves[0]
        T_map_odom = self._drift.T_map_odom(odometry.stamp_ns)
        moment = odometry.stamp_ns, odometry.T_odom_base
        return self._poses.next(moment, T_map_odom, self._drift.covariance, num_inliers, verdict)


def _at(moves: Sequence[Odometry], stamp_ns: int) -> SE3:
    """Return the odometry's pose at a moment; beyond its ends, that of the nearest message."""
    after = bisect_left(moves[:-1], stamp_ns, key=lambda move: move.stamp_ns)
    a, b = moves[max(after - 1, 0)], moves[after]
    fraction = (stamp_ns - a.stamp_ns) / max(b.stamp_ns - a.stamp_ns, 1)
    return a.T_odom_base.interpolate(b.T_odom_base, min(max(fraction, 0.0), 1.0))
