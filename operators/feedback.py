"""What an optimizer makes of the past, heard by those before it in a graph: each correction counts at a fixed time.

So a replay gives the same, however fast the optimizer is.
"""

from __future__ import annotations

from mapstream.operators.operator import warn
from mapstream.streams.channel import Receiver
from mapstream.streams.messages.estimates import MapCorrection

_SECOND_NS = 1_000_000_000


class Feedback:
    """Corrections of a graph's optimizer, each of which counts a fixed time after its stamp."""

    def __init__(self, feedback_s: float) -> None:
        self._delay_ns = round(feedback_s * _SECOND_NS)
        self._heard: list[MapCorrection] = []  # that do not count yet
        self._first_ns: int | None = None

    async def counting(
        self, corrections: Receiver[MapCorrection], stamp_ns: int
    ) -> list[MapCorrection]:
        """Return the corrections that begin to count at a stamp, asked in order; wait for those that may still come."""
        if self._first_ns is None:
            self._first_ns = stamp_ns
        counts_ns = stamp_ns - self._delay_ns
        while counts_ns >= self._first_ns and not (
            self._heard and self._heard[-1].stamp_ns > counts_ns
        ):
            correction = await anext(aiter(corrections), None)
            if correction is None:
                warn("the optimizer's corrections ended; odometry alone says where the robot is")
                return []
            self._heard.append(correction)
        num = sum(correction.stamp_ns <= counts_ns for correction in self._heard)
        counting, self._heard = self._heard[:num], self._heard[num:]
        return counting
