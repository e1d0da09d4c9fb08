"""Where a robot is in its mission by odometry, and by what an optimizer made of the past."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert
from mapstream.streams.messages.estimates import MapCorrection, Odometry


class Whereabouts:
    """Poses of the base at moments between messages of odometry; they follow corrections."""

    def __init__(self, lost_m: float) -> None:
        """Know nothing yet; a step without a measurement counts as so much way."""
        self._lost_m = lost_m
        self._before: Odometry | None = None
        self._newest: Odometry | None = None
        self._noted: dict[int, FloatArray] = {}  # T_odom_base by stamp
        self._corrected_ns: list[int] = []
        self._T_mission_odom: list[FloatArray] = []  # at these stamps
        self.path_m = 0.0  # the way so far

    def follow(self, odometry: Odometry) -> None:
        """Take the next message in."""
        self._before, self._newest = self._newest or odometry, odometry
        step = odometry.T_odom_base.t - self._before.T_odom_base.t
        self.path_m += float(np.linalg.norm(step)) + self._lost_m * odometry.is_lost

    def note(self, stamp_ns: int) -> FloatArray | None:
        """Return T_mission_base (4, 4) between the last two messages, and remember the moment; None beyond them."""
        a, b = self._before, self._newest
        if a is None or b is None or not a.stamp_ns <= stamp_ns <= b.stamp_ns:
            return None
        fraction = (stamp_ns - a.stamp_ns) / max(b.stamp_ns - a.stamp_ns, 1)
        self._noted[stamp_ns] = a.T_odom_base.interpolate(b.T_odom_base, fraction).matrix
        return self.at(stamp_ns)

    def at(self, stamp_ns: int) -> FloatArray:
        """Return T_mission_base (4, 4) at a moment that was noted, as it is known now."""
        row = bisect_right(self._corrected_ns, stamp_ns) - 1
        if row < 0:
            return self._noted[stamp_ns]
        T: FloatArray = self._T_mission_odom[row] @ self._noted[stamp_ns]
        return T

    def correct(self, correction: MapCorrection) -> None:
        """Take over the poses that an optimizer gave to the moments."""
        stamps_ns = correction.stamps_ns.tolist()
        rows = [row for row, stamp_ns in enumerate(stamps_ns) if stamp_ns in self._noted]
        self._corrected_ns = [stamps_ns[row] for row in rows]
        self._T_mission_odom = [
            correction.T_mission_base[row] @ invert(self._noted[stamps_ns[row]]) for row in rows
        ]
