"""A continuous pose source: the motion over any interval, from odometry of any rate.

Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section III-C: odometry is not put into the problem
message by message, but gathered into one factor between each two poses, whatever their stamps.
The limits of memory and prediction are those of maplab 2.0's odometry buffer.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mapstream.operators.odometry.uncertainty import chain, unmeasured
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.join import END
from mapstream.streams.messages.estimates import Odometry


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
        max_gap_ns: int | None = None,
    ) -> None:
        """Make a source.

        Args:
            default_covariance: (6, 6) of a step whose message has none.
            keep_ns: How far back intervals may begin, at least.
            max_prediction_ns: How far past the newest message they may end.
            max_gap_ns: Steps that take longer are not interpolated; None: all are.
        """
        self._default = default_covariance
        self._keep_ns = keep_ns
        self._max_prediction_ns = max_prediction_ns
        self._max_gap_ns = max_gap_ns
        self._stamps_ns: list[int] = []
        self._messages: list[Odometry] = []
        self._twists: list[
            FloatArray | None
        ] = []  # (6,) of the step to each message, when asked for
        self._between: dict[int, SE3] = {}  # interpolated poses, until the next message

    def __len__(self) -> int:
        return len(self._stamps_ns)

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """The stamps of the oldest and the newest message that are kept."""
        return (self._stamps_ns[0], self._stamps_ns[-1]) if self._stamps_ns else None

    def add(self, odometry: Odometry) -> None:
        """Take the next message in, and forget those that are too old.

        Raises:
            EstimationError: If it is not newer than the one before; `clear` first after a jump in time.
        """
        if self._stamps_ns and odometry.stamp_ns <= self._stamps_ns[-1]:
            raise EstimationError(
                f"odometry at {odometry.stamp_ns} ns is not newer than at {self._stamps_ns[-1]} ns"
            )
        self._stamps_ns.append(odometry.stamp_ns)
        self._messages.append(odometry)
        self._twists.append(None)
        self._between.clear()
        num_old = bisect_right(self._stamps_ns, odometry.stamp_ns - self._keep_ns) - 1
        if num_old > 0:
            del self._stamps_ns[:num_old], self._messages[:num_old], self._twists[:num_old]

    def clear(self) -> None:
        self._stamps_ns.clear()
        self._messages.clear()
        self._twists.clear()
        self._between.clear()

    def measures(self, start_ns: int, end_ns: int) -> bool:
        """Return whether messages without a gap enclose the interval: nothing need be predicted."""
        stamps = self._stamps_ns
        if len(stamps) < 2 or not stamps[0] <= start_ns <= end_ns <= stamps[-1]:
            return False
        if self._max_gap_ns is None:
            return True
        first, last = bisect_right(stamps, start_ns) - 1, bisect_left(stamps, end_ns)
        steps = pairwise(stamps[first : last + 1])
        return all(after - before <= self._max_gap_ns for before, after in steps)

    def covers(self, start_ns: int, end_ns: int) -> bool:
        """Return whether the interval can be answered, by a short prediction at its end if need be."""
        span = self.span_ns
        if span is None or len(self) < 2 or end_ns > span[1] + self._max_prediction_ns:
            return False
        end_ns, newest_ns = max(start_ns, end_ns), span[1]
        return start_ns <= end_ns and self.measures(
            min(start_ns, newest_ns), min(end_ns, newest_ns)
        )

    def is_decided(self, stamp_ns: int, known_ns: int) -> bool:
        """Return whether no message can still change what is said up to a stamp.

        Args:
            stamp_ns: Up to when.
            known_ns: All messages up to here have come.
        """
        if not self._stamps_ns:
            return known_ns >= stamp_ns  # the first message lies behind the stamp
        newest_ns = self._stamps_ns[-1]
        is_over = self._max_gap_ns is not None and known_ns > newest_ns + self._max_gap_ns
        return stamp_ns <= newest_ns or is_over or known_ns >= END

    def newest_before(self, stamp_ns: int) -> int | None:
        """Return the stamp of the newest message up to a stamp, None if there is none."""
        at = bisect_right(self._stamps_ns, stamp_ns) - 1
        return self._stamps_ns[at] if at >= 0 else None

    def between(self, start_ns: int, end_ns: int) -> Motion:
        """Return the motion over an interval.

        Raises:
            EstimationError: If the interval is not covered; nothing is made up.
        """
        if end_ns < start_ns or not self.covers(start_ns, end_ns):
            raise EstimationError(f"no odometry for {start_ns} to {end_ns} ns: {self._available()}")
        T_start = self.pose_at(start_ns)
        covariance = np.zeros((6, 6))
        is_measured = end_ns <= self._stamps_ns[-1]
        T_before = T_start
        for step_start_ns, step_end_ns in pairwise(self._knots(start_ns, end_ns)):
            T_after = self.pose_at(step_end_ns)
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

    def pose_at(self, stamp_ns: int) -> SE3:
        """Return T_odom_base, along the screw of the step around the stamp or its continuation.

        Raises:
            EstimationError: If the stamp lies before the oldest message, in a gap, or too far past the newest.
        """
        if not self.covers(stamp_ns, stamp_ns):
            raise EstimationError(f"no odometry at {stamp_ns} ns: {self._available()}")
        after = self._step(stamp_ns)
        start_ns, end_ns = self._stamps_ns[after - 1 : after + 1]
        if stamp_ns == end_ns:
            return self._messages[after].T_odom_base
        T_before = self._messages[after - 1].T_odom_base
        if stamp_ns == start_ns:
            return T_before
        if stamp_ns not in self._between:
            step = (stamp_ns - start_ns) / (end_ns - start_ns) * self._twist(after)
            self._between[stamp_ns] = T_before @ SE3.exp(step)
        return self._between[stamp_ns]

    def state_at(self, stamp_ns: int) -> Odometry:
        """Return the message at a stamp: its pose interpolated, velocity and biases of the nearest message.

        Raises:
            EstimationError: As `pose_at`.
        """
        T_odom_base = self.pose_at(stamp_ns)
        after = self._step(stamp_ns)
        before_ns, after_ns = self._stamps_ns[after - 1 : after + 1]
        nearest = self._messages[after - (stamp_ns - before_ns < after_ns - stamp_ns)]
        return Odometry(
            stamp_ns=stamp_ns,
            T_odom_base=T_odom_base,
            velocity_mps=nearest.velocity_mps,
            gyro_bias_radps=nearest.gyro_bias_radps,
            accel_bias_mps2=nearest.accel_bias_mps2,
        )

    def _available(self) -> str:
        span = self.span_ns
        if span is None or len(self) < 2:
            return "unavailable; there are no two messages yet"
        limit = f"{self._max_prediction_ns / 1e6:g} ms beyond"
        gap = "" if self._max_gap_ns is None else f", less gaps over {self._max_gap_ns / 1e6:g} ms"
        return f"unavailable; there is {span[0]} to {span[1]} ns and {limit}{gap}"

    def _knots(self, start_ns: int, end_ns: int) -> list[int]:
        first, last = bisect_right(self._stamps_ns, start_ns), bisect_left(self._stamps_ns, end_ns)
        return [start_ns, *self._stamps_ns[first:last], end_ns]

    def _step(self, stamp_ns: int) -> int:
        """Return the index of the message that ends the step around or before a stamp."""
        return min(max(bisect_left(self._stamps_ns, stamp_ns), 1), len(self._stamps_ns) - 1)

    def _twist(self, after: int) -> FloatArray:
        """Return the tangent vector (6,) of the step that ends at a message."""
        twist = self._twists[after]
        if twist is None:
            T_before, T_after = (self._messages[i].T_odom_base for i in (after - 1, after))
            twist = self._twists[after] = (T_before.inverse() @ T_after).log()
        return twist

    def _uncertainty(self, start_ns: int, end_ns: int) -> tuple[FloatArray, bool]:
        """Return the covariance (6, 6) of a piece of one step, and whether it was measured."""
        after = self._step(end_ns)
        if end_ns > self._stamps_ns[after]:
            return unmeasured((end_ns - start_ns) / 1e9), False
        message = self._messages[after]
        step = self._default if message.covariance is None else message.covariance
        share = (end_ns - start_ns) / (self._stamps_ns[after] - self._stamps_ns[after - 1])
        return share * step, not message.is_lost
