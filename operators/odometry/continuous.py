"""A continuous pose source: the motion over any interval, from odometry of any rate.

Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section III-C: odometry is not put into the problem
message by message, but gathered into one factor between each two poses, whatever their stamps.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mapstream.operators.odometry.uncertainty import chain, unmeasured
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What the source says of one interval."""

    T_start_end: SE3
    covariance: FloatArray  # (6, 6) at the end, rotation first [rad, m]
    is_measured: bool  # False if some of it was predicted, or no step of the odometry was measured


class ContinuousSource:
    """Odometry, kept for a while and answered for any interval inside it.

    Between two messages the pose is interpolated and the covariance is a share of the step's, so that
    motions over adjoining intervals compose exactly to the motion over both.
    Past the newest message the last velocity goes on, for a short time and with little confidence.
    """

    def __init__(
        self,
        default_covariance: FloatArray,
        *,
        keep_ns: int = 30_000_000_000,
        max_prediction_ns: int = 500_000_000,
    ) -> None:
        """Make a source.

        Args:
            default_covariance: (6, 6) of a step whose message has none.
            keep_ns: How far back intervals may begin, at least.
            max_prediction_ns: How far past the newest message they may end.
        """
        self._default = default_covariance
        self._keep_ns = keep_ns
        self._max_prediction_ns = max_prediction_ns
        self._stamps_ns: list[int] = []
        self._messages: list[Odometry] = []

    def add(self, odometry: Odometry) -> None:
        """Take the next message in.

        Raises:
            EstimationError: If it is not newer than the one before.
        """
        if self._stamps_ns and odometry.stamp_ns <= self._stamps_ns[-1]:
            raise EstimationError(
                f"odometry at {odometry.stamp_ns} ns is not newer than at {self._stamps_ns[-1]} ns"
            )
        self._stamps_ns.append(odometry.stamp_ns)
        self._messages.append(odometry)
        old = bisect_right(self._stamps_ns, odometry.stamp_ns - self._keep_ns) - 1
        if old > 1024:  # now and then, so that it costs nothing per message
            del self._stamps_ns[:old]
            del self._messages[:old]

    def covers(self, start_ns: int, end_ns: int) -> bool:
        """Return whether the interval can be answered."""
        if len(self._stamps_ns) < 2:
            return False
        newest_ns = self._stamps_ns[-1] + self._max_prediction_ns
        return self._stamps_ns[0] <= start_ns <= end_ns <= newest_ns

    def between(self, start_ns: int, end_ns: int) -> Motion:
        """Return the motion over an interval.

        Raises:
            EstimationError: If the interval is not covered; nothing is made up.
        """
        if not self.covers(start_ns, end_ns):
            known = "no two messages yet"
            if len(self._stamps_ns) >= 2:
                known = f"{self._stamps_ns[0]} to {self._stamps_ns[-1]} ns"
            limit = f"and {self._max_prediction_ns / 1e6:g} ms beyond"
            raise EstimationError(
                f"no odometry for {start_ns} to {end_ns} ns: unavailable; there is {known} {limit}"
            )
        T_start = self._pose(start_ns)
        covariance = np.zeros((6, 6))
        is_measured = end_ns <= self._stamps_ns[-1]
        T_before = T_start
        for step_start_ns, step_end_ns in pairwise(self._knots(start_ns, end_ns)):
            T_after = self._pose(step_end_ns)
            share, measured = self._uncertainty(step_start_ns, step_end_ns)
            covariance = chain(covariance, T_before.inverse() @ T_after, share)
            is_measured &= measured
            T_before = T_after
        return Motion(T_start.inverse() @ T_before, covariance, is_measured)

    def links(self, stamps_ns: Sequence[int]) -> list[Motion]:
        """Return one motion for each two consecutive stamps.

        Raises:
            EstimationError: As `between`.
        """
        return [self.between(start, end) for start, end in pairwise(stamps_ns)]

    def _knots(self, start_ns: int, end_ns: int) -> list[int]:
        first, last = bisect_right(self._stamps_ns, start_ns), bisect_left(self._stamps_ns, end_ns)
        return [start_ns, *self._stamps_ns[first:last], end_ns]

    def _step(self, stamp_ns: int) -> int:
        """Return the index of the message that ends the step around or before a stamp."""
        return min(max(bisect_left(self._stamps_ns, stamp_ns), 1), len(self._stamps_ns) - 1)

    def _pose(self, stamp_ns: int) -> SE3:
        """Return T_odom_base, along the screw of the step or its continuation."""
        after = self._step(stamp_ns)
        T_before, T_after = (self._messages[i].T_odom_base for i in (after - 1, after))
        start_ns, end_ns = self._stamps_ns[after - 1 : after + 1]
        if stamp_ns == end_ns:
            return T_after
        fraction = (stamp_ns - start_ns) / (end_ns - start_ns)
        return T_before @ SE3.exp(fraction * (T_before.inverse() @ T_after).log())

    def _uncertainty(self, start_ns: int, end_ns: int) -> tuple[FloatArray, bool]:
        """Return the covariance (6, 6) of a piece of one step, and whether it was measured."""
        after = self._step(end_ns)
        if end_ns > self._stamps_ns[after]:
            return unmeasured((end_ns - start_ns) / 1e9), False
        message = self._messages[after]
        step = self._default if message.covariance is None else message.covariance
        share = (end_ns - start_ns) / (self._stamps_ns[after] - self._stamps_ns[after - 1])
        return share * step, not message.is_lost
