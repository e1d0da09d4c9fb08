"""What all joins share: ports that hand out messages in stamp order, counts, and the wait.

A join decides by stamps and bounds alone. A bound that comes earlier or later changes when a decision
is made, never which: so the same streams give the same tuples however their arrivals interleave.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_right, insort
from collections import Counter
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from mapstream.streams.channel import BEGINNING, Receiver
from mapstream.streams.messages.sensors import Message

M = TypeVar("M", bound=Message)
T = TypeVar("T")
END = 2**63 - 1  # the bound of a port that has ended


def stamp_of(message: Message) -> int:
    """Return the stamp [ns]: the order in which a port hands out its messages."""
    return message.stamp_ns


@dataclass(slots=True)
class JoinStats:
    """What a join did so far."""

    matched: int = 0
    unmatched: Counter[tuple[str, str]] = field(default_factory=Counter)  # by port and reason
    absent: Counter[str] = field(default_factory=Counter)  # optional ports that had nothing to give
    late: Counter[str] = field(default_factory=Counter)  # behind their port's bound, and dropped
    nearest_miss_ns: dict[tuple[str, str], int] = field(default_factory=dict)  # as far as seen

    def miss(self, port: str, reason: str, gap_ns: int | None = None) -> None:
        """Count a message that found no partner; the gap is how far the best one was out."""
        self.unmatched[port, reason] += 1
        if gap_ns is not None:
            known = self.nearest_miss_ns.get((port, reason), gap_ns)
            self.nearest_miss_ns[port, reason] = min(known, gap_ns)

    def explain(self) -> str:
        """Say in one line what matched, which port was missing, and by how much."""
        parts = [f"{self.matched} matched"]
        for (port, reason), count in sorted(self.unmatched.items()):
            gap_ns = self.nearest_miss_ns.get((port, reason))
            spread = "" if gap_ns is None else f" (the closest was {gap_ns / 1e6:.3f} ms off)"
            parts.append(f"{count} of {port} not: {reason}{spread}")
        parts += [f"{count} without {port}" for port, count in sorted(self.absent.items())]
        parts += [f"{count} of {port} came too late" for port, count in sorted(self.late.items())]
        return "; ".join(parts)


class Port(Generic[M]):
    """What a join took from one receiver and still holds, in stamp order."""

    def __init__(self, receiver: Receiver[M], index: int, stats: JoinStats) -> None:
        self.receiver = receiver
        self.index = index
        self.name = receiver.channel.name or f"port {index}"
        self.held: list[M] = []
        self.last_ns = BEGINNING  # the newest stamp taken
        self.late: list[M] | None = None  # a list, if late messages are wanted all the same
        self._stats = stats

    @property
    def bound_ns(self) -> int:
        """The least stamp that a message not held yet may have; `END` after the last."""
        return END if self.receiver.is_at_epoch_end else self.receiver.bound_ns

    @property
    def next_ns(self) -> int:
        """The least stamp that the next message in order may have."""
        bound_ns = self.bound_ns
        return min(self.held[0].stamp_ns, bound_ns) if self.held else bound_ns

    @property
    def first(self) -> M | None:
        """The next message in order, or None while another may still come before it."""
        return self.held[0] if self.held and self.held[0].stamp_ns <= self.bound_ns else None

    def known(self) -> Sequence[M]:
        """Return the messages held that no other can come before or between."""
        bound_ns = self.bound_ns
        if not self.held or self.held[-1].stamp_ns <= bound_ns:
            return self.held
        return self.held[: bisect_right(self.held, bound_ns, key=stamp_of)]

    def pull(self) -> bool:
        """Take one message from the receiver; False if none is there now."""
        message = self.receiver.try_receive_in_epoch()
        if message is None:
            return False
        if message.stamp_ns < self.receiver.arrival.bound_ns:
            self._stats.late[self.name] += 1
            if self.late is not None:
                self.late.append(message)
        else:
            insort(self.held, message, key=stamp_of)
            self.last_ns = max(self.last_ns, message.stamp_ns)
        return True

    def hear(self, stamp_ns: int) -> bool:
        """Take all messages up to a stamp; False if one may still be to come."""
        while self.bound_ns <= stamp_ns:
            if not self.pull():
                return False
        return True

    def start_epoch(self) -> None:
        """Forget what is held: time starts anew."""
        self.held.clear()
        if self.late is not None:
            self.late.clear()
        self.last_ns = BEGINNING

    def forget_before(self, index: int) -> None:
        """Drop messages from the front, up to one that is still wanted."""
        if index > 0:
            del self.held[:index]


class Join(ABC, Generic[T]):
    """An async iterator of what belongs together; it ends when nothing more can match.

    Of receivers that span epochs, messages of different epochs never meet: a port waits at its mark
    until the others have come to theirs.
    """

    def __init__(self, receivers: Sequence[Receiver[Any]]) -> None:
        if not receivers:
            raise ValueError("a join needs at least one receiver")
        self.stats = JoinStats()
        self.ports = [Port(receiver, i, self.stats) for i, receiver in enumerate(receivers)]
        self._leading = self.ports  # the join goes on while one of these does

    @abstractmethod
    def _decide(self) -> T | Port[Any] | None:
        """Return a tuple, or the port that must be heard first, or None at the end."""

    def explain(self) -> str:
        """Say in one line what matched and what did not, and why."""
        return f"{', '.join(port.name for port in self.ports)}: {self.stats.explain()}"

    def __aiter__(self) -> AsyncIterator[T]:
        return self

    async def __anext__(self) -> T:
        while True:
            found = self._decide()
            if isinstance(found, Port):
                await found.receiver.wait()
            elif found is not None:
                self.stats.matched += 1
                return found
            elif not await self._enter_next_epoch():
                raise StopAsyncIteration

    async def _enter_next_epoch(self) -> bool:
        """Read all ports up to their marks and step over them; False if no leading port has one."""
        if not any(p.receiver.is_at_epoch_end and not p.receiver.has_ended for p in self._leading):
            return False
        for port in self.ports:
            while not port.receiver.is_at_epoch_end:
                if not port.pull():
                    await port.receiver.wait()
                port.held.clear()
            port.receiver.cross_epoch()
            port.start_epoch()
        return True
