"""Joins of several receivers, decided by stamps and bounds, never by arrival.

`merge` orders, `exact` and `approximate` pair equals, `anchored` gives each message of one port what
the others have around it. All are async iterators with `stats` and `explain()`.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Sequence
from typing import Any, TypeVar, overload

from mapstream.streams.anchored import anchored, interpolate, latest, nearest, window
from mapstream.streams.channel import Receiver
from mapstream.streams.extent import cut_imu, extent_of
from mapstream.streams.join import END, Join, JoinStats, Port, stamp_of
from mapstream.streams.messages.sensors import Message

__all__ = [
    "Join",
    "JoinStats",
    "anchored",
    "approximate",
    "cut_imu",
    "exact",
    "extent_of",
    "interpolate",
    "latest",
    "merge",
    "nearest",
    "window",
]

M1 = TypeVar("M1", bound=Message)
M2 = TypeVar("M2", bound=Message)
M3 = TypeVar("M3", bound=Message)


def _next_port(ports: Sequence[Port[Any]]) -> Port[Any]:
    """Return the port whose next message may be the oldest; the first of equals."""
    return min(ports, key=lambda port: port.next_ns)


class Merge(Join[tuple[int, Any]]):
    """See `merge`."""

    def __init__(
        self,
        receivers: Sequence[Receiver[Any]],
        *,
        keeps_late: bool = False,
        delays_ns: Sequence[int] = (),
    ) -> None:
        super().__init__(receivers)
        self._delays_ns = delays_ns or [0] * len(self.ports)
        if keeps_late:
            for port in self.ports:
                port.late = []

    def _decide(self) -> tuple[int, Any] | Port[Any] | None:
        while True:
            for port in self.ports:
                if port.late:
                    return port.index, port.late.pop(0)
            port = min(self.ports, key=lambda port: port.next_ns + self._delays_ns[port.index])
            if port.next_ns == END:
                return None
            message = port.first
            if message is not None:
                port.forget_before(1)
                return port.index, message
            if not port.pull():
                return port


class Exact(Join[tuple[Any, ...]]):
    """See `exact`."""

    def _decide(self) -> tuple[Any, ...] | Port[Any] | None:
        while True:
            stamp_ns = _next_port(self.ports).next_ns
            if stamp_ns == END:
                return None
            undecided = next((p for p in self.ports if p.next_ns == stamp_ns and not p.first), None)
            if undecided is not None:
                if not undecided.pull():
                    return undecided
                continue
            present = [p for p in self.ports if p.next_ns == stamp_ns]
            messages = tuple(p.held.pop(0) for p in present)
            if len(present) == len(self.ports):
                return messages
            missing = next(p for p in self.ports if p not in present)
            for port in present:
                self.stats.miss(port.name, f"no {missing.name} at its stamp")


class Approximate(Join[tuple[Any, ...]]):
    """See `approximate`."""

    def __init__(self, receivers: Sequence[Receiver[Any]], within_ns: int) -> None:
        super().__init__(receivers)
        self._within_ns = within_ns
        self._left: Counter[int] = Counter()  # by port, after another has ended
        self._within = f"within {within_ns / 1e6:g} ms"

    def _decide(self) -> tuple[Any, ...] | Port[Any] | None:
        while all(port.next_ns < END for port in self.ports):
            waiting = next((p for p in self.ports if p.first is None), None)
            if waiting is None:
                found = self._around(max(self.ports, key=lambda port: port.next_ns))
                if found is not None:
                    return found
            elif not waiting.pull():
                return waiting
        return self._drain()

    def _drain(self) -> Port[Any] | None:
        """Count what is left when a port has ended; it matches nothing."""
        for port in self.ports:
            while port.next_ns < END:
                self._left[port.index] += len(port.held)
                port.held.clear()
                if port.bound_ns < END and not port.pull():
                    return port
        ended = min(self.ports, key=lambda port: port.last_ns)
        for index, count in self._left.items():
            self.stats.unmatched[self.ports[index].name, f"no {ended.name} any more"] += count
        self._left.clear()
        return None

    def _around(self, pivot: Port[Any]) -> tuple[Any, ...] | Port[Any] | None:
        """Return the narrowest set that contains the newest of the heads; no set can be older.

        Every port gives its last message before the pivot's stamp or its first one from there on.
        The search begins with the former and exchanges the oldest for its successor while it can.
        None if no set is narrow enough: then the pivot and what is too old for its successors go.
        """
        pivot_ns = pivot.next_ns
        deaf = next((p for p in self.ports if not p.hear(pivot_ns - 1)), None)
        if deaf is not None:
            return deaf
        chosen = [max(bisect_left(p.held, pivot_ns, key=stamp_of) - 1, 0) for p in self.ports]
        stamps = [p.held[i].stamp_ns for p, i in zip(self.ports, chosen, strict=True)]
        culprit = self.ports[stamps.index(min(stamps))]
        last_ns = pivot_ns + min(pivot_ns - min(stamps), self._within_ns)
        for port, stamp_ns in zip(self.ports, stamps, strict=True):
            decided = stamp_ns == pivot_ns or port.known()[-1].stamp_ns >= pivot_ns
            if not decided and not port.hear(last_ns):
                return port
        best, spread_ns = self._narrowest(chosen, stamps, pivot_ns, last_ns)
        if spread_ns <= self._within_ns:
            for port, index in zip(self.ports, best, strict=True):
                self._drop(port, index, "others were closer together")
            return tuple(port.held.pop(0) for port in self.ports)
        self.stats.miss(pivot.name, f"no {culprit.name} {self._within}", spread_ns)
        pivot.forget_before(1)
        for port in self.ports:
            too_old = bisect_left(port.held, pivot_ns - self._within_ns, key=stamp_of)
            self._drop(port, too_old, f"no {pivot.name} {self._within}")
        return None

    def _narrowest(
        self, chosen: list[int], stamps: list[int], pivot_ns: int, last_ns: int
    ) -> tuple[list[int], int]:
        """Return the indices of the narrowest set up to `last_ns`, and its spread [ns]."""
        best, spread_ns = list(chosen), pivot_ns - min(stamps)
        while (oldest_ns := min(stamps)) < pivot_ns:
            i = stamps.index(oldest_ns)
            known = self.ports[i].known()
            if chosen[i] + 1 == len(known) or known[chosen[i] + 1].stamp_ns > last_ns:
                break
            chosen[i] += 1
            stamps[i] = known[chosen[i]].stamp_ns
            if max(stamps) - min(stamps) < spread_ns:
                best, spread_ns = list(chosen), max(stamps) - min(stamps)
        return best, spread_ns

    def _drop(self, port: Port[Any], count: int, reason: str) -> None:
        for _ in range(count):
            self.stats.miss(port.name, reason)
        port.forget_before(count)


@overload
def merge(receiver1: Receiver[M1], /) -> Join[tuple[int, M1]]: ...
@overload
def merge(
    receiver1: Receiver[M1], receiver2: Receiver[M2], /, *, delays_ns: Sequence[int] = ...
) -> Join[tuple[int, M1 | M2]]: ...
@overload
def merge(*receivers: Receiver[Any], keeps_late: bool = ...) -> Join[tuple[int, Any]]: ...
def merge(
    *receivers: Receiver[Any], keeps_late: bool = False, delays_ns: Sequence[int] = ()
) -> Join[Any]:
    """Join: (port index, message) of all receivers in stamp order, equal stamps in port order.

    It ends when all have ended; one that ended no longer holds the others back.
    A message behind its port's bound is dropped, or with `keeps_late` comes as soon as it is seen.
    With `delays_ns`, one for each receiver, messages come as if their stamps were so much newer: what takes long
    to be made does not hold the others back.
    """
    return Merge(receivers, keeps_late=keeps_late, delays_ns=delays_ns)


@overload
def exact(receiver1: Receiver[M1], receiver2: Receiver[M2], /) -> Join[tuple[M1, M2]]: ...
@overload
def exact(
    receiver1: Receiver[M1], receiver2: Receiver[M2], receiver3: Receiver[M3], /
) -> Join[tuple[M1, M2, M3]]: ...
@overload
def exact(*receivers: Receiver[Any]) -> Join[tuple[Any, ...]]: ...
def exact(*receivers: Receiver[Any]) -> Join[Any]:
    """Join: one tuple for each stamp that every receiver has; the rest is counted as unmatched."""
    return Exact(receivers)


@overload
def approximate(
    receiver1: Receiver[M1], receiver2: Receiver[M2], /, *, within_ns: int
) -> Join[tuple[M1, M2]]: ...
@overload
def approximate(
    receiver1: Receiver[M1], receiver2: Receiver[M2], receiver3: Receiver[M3], /, *, within_ns: int
) -> Join[tuple[M1, M2, M3]]: ...
@overload
def approximate(*receivers: Receiver[Any], within_ns: int) -> Join[tuple[Any, ...]]: ...
def approximate(*receivers: Receiver[Any], within_ns: int) -> Join[Any]:
    """Join: tuples of one message per receiver, as close together as can be, each message once.

    The idea is that of ROS' ApproximateTime policy: of all sets with the newest of the oldest waiting
    messages the one with the least spread wins. A set wider than `within_ns` is none.
    """
    return Approximate(receivers, within_ns)
