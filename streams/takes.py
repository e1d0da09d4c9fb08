"""What a join takes from a port for one anchor: the nearest, the latest, a window, or a blend of two.

Anchors come in stamp order, so a take forgets what no later anchor can want.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from mapstream.streams.channel import Receiver
from mapstream.streams.extent import Extent, extent_of
from mapstream.streams.join import Port, stamp_of
from mapstream.streams.messages.sensors import Message

M = TypeVar("M", bound=Message)
R_co = TypeVar("R_co", covariant=True)
V = TypeVar("V")


@dataclass(frozen=True, slots=True)
class Missing:
    """Why a port has nothing for an anchor, and how far out the best of it was."""

    reason: str
    gap_ns: int | None = None


class Take(ABC, Generic[R_co]):
    """What one port gives to each anchor. A receiver of None is an optional port left unconnected."""

    def __init__(self, receiver: Receiver[Any] | None, *, optional: bool) -> None:
        if receiver is None and not optional:
            raise ValueError("a port that may be unconnected needs optional=True")
        self.receiver = receiver
        self.is_optional = optional

    @abstractmethod
    def find(self, port: Port[Any], stamp_ns: int, extent: Extent) -> R_co | Missing | Port[Any]:
        """Return the content, or why there is none, or the port itself if it must be heard first."""


@dataclass(frozen=True, slots=True)
class _Around(Generic[M]):
    before: M | None  # the last one before the anchor
    after: M | None  # the first one at the anchor or after


def _around(
    port: Port[M], stamp_ns: int, within_ns: int, *, needs_both: bool
) -> _Around[M] | Port[M]:
    """Return the neighbours of a stamp; `after` is None if it is out of reach."""
    while True:
        known = port.known()
        at = bisect_left(known, stamp_ns, key=stamp_of)
        before = known[at - 1] if at else None
        if at < len(known):
            after = known[at]
            port.forget_before(at - 1)
            return _Around(before, after)
        reach_ns = within_ns
        if before is not None and not needs_both:
            reach_ns = min(within_ns, stamp_ns - before.stamp_ns)
        if port.bound_ns > stamp_ns + reach_ns:
            port.forget_before(at - 1)
            return _Around(before, None)
        if not port.pull():
            return port


def _none_within(port: Port[Any], within_ns: int, gap_ns: int | None = None) -> Missing:
    return Missing(f"no {port.name} within {within_ns / 1e6:g} ms", gap_ns)


class Nearest(Take[M]):
    """The message closest in time; of two equally close the earlier."""

    def __init__(self, receiver: Receiver[M] | None, within_ns: int, *, optional: bool) -> None:
        super().__init__(receiver, optional=optional)
        self._within_ns = within_ns

    def find(self, port: Port[M], stamp_ns: int, extent: Extent) -> M | Missing | Port[M]:  # noqa: ARG002  # as declared
        around = _around(port, stamp_ns, self._within_ns, needs_both=False)
        if isinstance(around, Port):
            return around
        candidates = [m for m in (around.before, around.after) if m is not None]
        if not candidates:
            return _none_within(port, self._within_ns)
        best = min(candidates, key=lambda m: abs(m.stamp_ns - stamp_ns))
        gap_ns = abs(best.stamp_ns - stamp_ns)
        return best if gap_ns <= self._within_ns else _none_within(port, self._within_ns, gap_ns)


class Latest(Take[M]):
    """The last message at or before the anchor."""

    def find(self, port: Port[M], stamp_ns: int, extent: Extent) -> M | Missing | Port[M]:  # noqa: ARG002  # as declared
        if not port.hear(stamp_ns):
            return port
        known = port.known()
        after = bisect_right(known, stamp_ns, key=stamp_of)
        if after == 0:
            return Missing(f"no {port.name} so far")
        found = known[after - 1]
        port.forget_before(after - 1)
        return found


class Interpolate(Take[V], Generic[M, V]):
    """What `function(before, after, stamp_ns)` makes of the two neighbours."""

    def __init__(
        self,
        receiver: Receiver[M] | None,
        within_ns: int,
        function: Callable[[M, M, int], V],
        *,
        optional: bool,
    ) -> None:
        super().__init__(receiver, optional=optional)
        self._within_ns = within_ns
        self._function = function

    def find(self, port: Port[M], stamp_ns: int, extent: Extent) -> V | Missing | Port[M]:  # noqa: ARG002  # as declared
        around = _around(port, stamp_ns, self._within_ns, needs_both=True)
        if isinstance(around, Port):
            return around
        before, after = around.before, around.after
        if after is not None and after.stamp_ns == stamp_ns:
            return self._function(after, after, stamp_ns)
        if before is None or after is None:
            side = "before" if before is None else "after"
            return Missing(f"no {port.name} within {self._within_ns / 1e6:g} ms {side} it")
        gap_ns = max(stamp_ns - before.stamp_ns, after.stamp_ns - stamp_ns)
        if gap_ns > self._within_ns:
            return _none_within(port, self._within_ns, gap_ns)
        return self._function(before, after, stamp_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach(Generic[M]):
    """Which stretch a window has around its anchor, and what becomes of the messages in it."""

    before_ns: int
    after_ns: int
    cover: bool
    patience_ns: int
    cut: Callable[[M, int, int], M] | None


class Window(Take[tuple[M, ...]], Generic[M]):
    """All messages that overlap the anchor's extent, widened by `before_ns` and `after_ns`."""

    def __init__(self, receiver: Receiver[M] | None, reach: Reach[M], *, optional: bool) -> None:
        super().__init__(receiver, optional=optional)
        self._reach = reach

    def find(
        self,
        port: Port[M],
        stamp_ns: int,  # noqa: ARG002  # as declared
        extent: Extent,
    ) -> tuple[M, ...] | Missing | Port[M]:
        reach = self._reach
        wanted = Extent(extent.start_ns - reach.before_ns, extent.end_ns + reach.after_ns)
        closing = self._closing(port, wanted.end_ns)
        if isinstance(closing, Port):
            return closing
        known = port.known()
        opening = bisect_right(known, wanted.start_ns, key=lambda m: extent_of(m).start_ns) - 1
        found: list[M] | Missing
        if reach.cover:
            found = self._covering(port, opening, closing, wanted)
        else:
            found = self._overlapping(known, closing, wanted)
        if opening >= 0:  # and what started with it, for the next anchor may have the same stamp
            start_ns = extent_of(known[opening]).start_ns
            port.forget_before(bisect_left(known, start_ns, key=lambda m: extent_of(m).start_ns))
        if isinstance(found, Missing):
            return found
        return tuple(found if reach.cut is None else (reach.cut(m, *wanted) for m in found))

    def _closing(self, port: Port[M], end_ns: int) -> int | Port[M]:
        """Return the index of the first message that reaches the end, or -1 if none does in time."""
        reach = self._reach
        while True:
            known = port.known()
            first = bisect_left(known, end_ns, key=lambda m: extent_of(m).end_ns)
            closes = first < len(known) and known[first].stamp_ns <= end_ns + reach.patience_ns
            if closes and (reach.cover or port.bound_ns > end_ns):
                return first
            if not closes and port.bound_ns > end_ns + reach.patience_ns:
                return -1
            if not port.pull():
                return port

    def _covering(
        self, port: Port[M], opening: int, closing: int, wanted: Extent
    ) -> list[M] | Missing:
        """Return the messages from the last that starts in time to the first that reaches the end."""
        known, reach = port.known(), self._reach
        if opening < 0:
            gap_ns = extent_of(known[0]).start_ns - wanted.start_ns if known else None
            return Missing(f"{port.name} begins after the window", gap_ns)
        gap_ns = wanted.start_ns - extent_of(known[opening]).end_ns
        if gap_ns > reach.patience_ns:
            return Missing(f"{port.name} has a gap before the window", gap_ns)
        if closing < 0:
            gap_ns = wanted.end_ns - extent_of(known[-1]).end_ns
            return Missing(f"{port.name} does not reach the window's end", max(gap_ns, 0))
        return list(known[opening : closing + 1])

    def _overlapping(self, known: Sequence[M], closing: int, wanted: Extent) -> list[M]:
        last_ns = wanted.end_ns + (self._reach.patience_ns if closing < 0 else 0)
        found = []
        for i, message in enumerate(known):
            extent = extent_of(message)
            overlaps = extent.start_ns <= wanted.end_ns and extent.end_ns >= wanted.start_ns
            if overlaps and (i <= closing or message.stamp_ns <= last_ns):
                found.append(message)
        return found
