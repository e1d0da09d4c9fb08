"""Bounded, typed channels between operators, on one event loop.

A channel is a deque with a limit, a policy for when it is full, and a **time bound**: the least stamp
that may still come. Joins decide by bounds, so a dropped or missing message never starves them.
anyio's own memory streams cost about 10 us a hop, since each call makes a checkpoint; this costs under 1.
Parks (Bounded Scheduling of Process Networks, 1995) shows how blocking channels stay bounded and yet
never deadlock: `grow` is for the runtime that follows him.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, Protocol, TypeVar

import anyio
import anyio.lowlevel

from mapstream.streams.errors import ChannelError
from mapstream.streams.messages.sensors import Message
from mapstream.streams.sizes import nbytes

T = TypeVar("T", bound=Message)
T_co = TypeVar("T_co", bound=Message, covariant=True)
T_contra = TypeVar("T_contra", bound=Message, contravariant=True)

BEGINNING = -(2**63)  # the bound of a channel that has seen nothing
Policy = Literal["block", "drop_oldest", "drop_newest", "latest", "spool", "error"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """How much a channel holds, and what happens to the message that is too many."""

    policy: Policy = "block"
    capacity: int = 8  # messages; `latest` holds one whatever this says
    max_bytes: int | None = None
    max_age_ns: int | None = None  # older messages are dropped when they are taken, by arrival
    lateness_ns: int = 0  # how far behind the newest stamp a message may still come


@dataclass(slots=True)
class ChannelStats:
    """What passed through a channel so far."""

    sent: int = 0
    received: int = 0
    dropped: Counter[str] = field(default_factory=Counter)  # by reason: full, age, unread
    late: int = 0  # messages behind the bound: delivered, but joins may have passed them
    high_water: int = 0
    grown: int = 0
    blocked_ns: int = 0  # time that senders waited for room


class Overflow(Protocol):
    """Where a `spool` channel keeps what it cannot hold, first in, first out."""

    def __len__(self) -> int: ...
    def put(self, item: tuple[Any, int]) -> bool: ...  # False: no room there either
    def get(self) -> tuple[Any, int]: ...


@dataclass(frozen=True, slots=True)
class _EpochMark:
    epoch: int


@dataclass(frozen=True, slots=True)
class Arrival:
    """What the channel knows of the message that was taken last."""

    sequence: int
    arrived_ns: int  # monotonic clock
    epoch: int


class Channel(Generic[T]):
    """One edge of a graph: one sender's messages for one receiver."""

    def __init__(
        self, name: str = "", limits: Limits | None = None, overflow: Overflow | None = None
    ) -> None:
        self.name = name
        self.limits = limits or Limits()
        self.stats = ChannelStats()
        self.capacity = 1 if self.limits.policy == "latest" else self.limits.capacity
        self.bound_ns = BEGINNING
        self.is_closed = False  # by the sender: what is queued is still delivered
        self.is_abandoned = False  # by the receiver: nothing is queued any more
        self._overflow = overflow
        self._items: deque[tuple[T | _EpochMark, int, int]] = deque()
        self._num_bytes = 0
        self._epoch = 0
        self._changed: anyio.Event | None = None  # a receiver waits: item, bound or end
        self._room: anyio.Event | None = None  # a sender waits
        if self.limits.policy == "spool" and overflow is None:
            raise ValueError(f"channel {name}: the policy spool needs a place for the overflow")

    def __len__(self) -> int:
        return len(self._items) + (len(self._overflow) if self._overflow else 0)

    @property
    def is_receiver_waiting(self) -> bool:
        return self._changed is not None

    @property
    def is_sender_waiting(self) -> bool:
        return self._room is not None

    def _is_full(self) -> bool:
        if len(self._items) >= self.capacity:
            return True
        limit = self.limits.max_bytes
        return limit is not None and self._num_bytes >= limit and bool(self._items)

    def _wake_receiver(self) -> None:
        if self._changed is not None:
            self._changed.set()
            self._changed = None

    def _wake_sender(self) -> None:
        if self._room is not None:
            self._room.set()
            self._room = None

    async def put(self, message: T) -> None:
        """Queue one message by the channel's policy.

        Raises:
            ChannelError: If the channel is closed, or is full under the policy `error`.
        """
        if self.is_closed:
            raise ChannelError(f"{self.name}: a message was sent after the end of the stream")
        stats = self.stats
        sequence = stats.sent
        stats.sent = sequence + 1
        stamp_ns = message.stamp_ns
        if stamp_ns < self.bound_ns:
            stats.late += 1
        else:
            self.bound_ns = stamp_ns - self.limits.lateness_ns
        if self.is_abandoned:
            stats.dropped["unread"] += 1
            return
        if self._is_full() and not await self._make_room(message):
            return
        self._append(message, sequence)

    def _append(self, item: T | _EpochMark, sequence: int) -> None:
        self._items.append((item, sequence, time.monotonic_ns()))
        if self.limits.max_bytes is not None:
            self._num_bytes += nbytes(item)
        self.stats.high_water = max(self.stats.high_water, len(self._items))
        self._wake_receiver()

    async def _make_room(self, message: T) -> bool:
        """Act as the policy says; True if the message may be queued."""
        policy = self.limits.policy
        if policy == "block":
            started_ns = time.monotonic_ns()
            while self._is_full() and not self.is_abandoned:
                if self._room is None:
                    self._room = anyio.Event()
                await self._room.wait()
            self.stats.blocked_ns += time.monotonic_ns() - started_ns
            return not self.is_abandoned
        if policy == "error":
            raise ChannelError(f"{self.name}: full with {len(self._items)} messages")
        if policy == "spool":
            if self._overflow is not None and self._overflow.put((message, self.stats.sent - 1)):
                return False
            self.stats.dropped["full"] += 1
            return False
        self.stats.dropped["full"] += 1
        if policy != "drop_newest":
            self._pop()
        self._wake_receiver()  # the bound moved, even where the message is lost
        await anyio.lowlevel.checkpoint()  # a sender that never waits must not starve the rest
        return policy != "drop_newest"

    def _pop(self) -> tuple[T | _EpochMark, int, int]:
        entry = self._items.popleft()
        if self.limits.max_bytes is not None:
            self._num_bytes -= nbytes(entry[0])
        if self._overflow:
            self._append(*self._overflow.get())
        self._wake_sender()
        return entry

    def advance(self, bound_ns: int) -> None:
        """Promise that no message older than `bound_ns` will follow."""
        if bound_ns > self.bound_ns:
            self.bound_ns = bound_ns
            self._wake_receiver()

    def start_epoch(self) -> None:
        """Mark that time starts anew: after a seek, a loop, a jump of the clock."""
        self._epoch += 1
        self.bound_ns = BEGINNING
        self._append(_EpochMark(self._epoch), -1)

    def close(self) -> None:
        """End the stream; the receiver still gets what is queued."""
        self.is_closed = True
        self._wake_receiver()

    def abandon(self) -> None:
        """Stop receiving; what is queued and what follows is counted as unread."""
        self.is_abandoned = True
        self.stats.dropped["unread"] += sum(not isinstance(i[0], _EpochMark) for i in self._items)
        self._items.clear()
        self._wake_sender()

    def grow(self, capacity: int) -> None:
        """Hold more messages: the way out of a deadlock by a full channel (Parks, section 4.2)."""
        self.capacity = capacity
        self.stats.grown += 1
        self._wake_sender()

    async def wait_changed(self) -> None:
        """Wait until a message, a new bound or the end comes."""
        if self._changed is None:
            self._changed = anyio.Event()
        await self._changed.wait()


class Receiver(Generic[T_co]):
    """The end of a channel that an operator reads.

    Iteration ends with the stream, and at the end of an epoch: then the runtime starts the operator
    anew. A receiver with `spans_epochs` reads on, and `arrival.epoch` says where it is.
    """

    def __init__(self, channel: Channel[T_co], *, spans_epochs: bool = False) -> None:
        self.channel = channel
        self.spans_epochs = spans_epochs
        self.epoch = 0
        self._last = (-1, 0)

    @property
    def bound_ns(self) -> int:
        """The least stamp that a message may still have, those in the queue included."""
        items = self.channel._items  # noqa: SLF001  # the two ends are one mechanism
        for item, _, _ in items:
            return (
                BEGINNING
                if isinstance(item, _EpochMark)
                else min(item.stamp_ns, self.channel.bound_ns)
            )
        return self.channel.bound_ns

    @property
    def has_ended(self) -> bool:
        """True if nothing more comes in this epoch."""
        items = self.channel._items  # noqa: SLF001
        if items:
            return isinstance(items[0][0], _EpochMark) and not self.spans_epochs
        return self.channel.is_closed

    @property
    def arrival(self) -> Arrival:
        return Arrival(self._last[0], self._last[1], self.epoch)

    def peek(self) -> T_co | None:
        """Return the next message without taking it, or None if none is queued now."""
        self._skip()
        items = self.channel._items  # noqa: SLF001
        head = items[0][0] if items else None
        return None if isinstance(head, _EpochMark) else head

    def _skip(self) -> None:
        """Drop what is too old, and cross into the next epoch if this receiver may."""
        channel = self.channel
        items, max_age_ns = channel._items, channel.limits.max_age_ns  # noqa: SLF001
        while items:
            item, _, arrived_ns = items[0]
            if isinstance(item, _EpochMark):
                if not self.spans_epochs:
                    return
                self.epoch = item.epoch
            elif max_age_ns is not None and time.monotonic_ns() - arrived_ns > max_age_ns:
                channel.stats.dropped["age"] += 1
            else:
                return
            channel._pop()  # noqa: SLF001

    def try_receive(self) -> T_co | None:
        """Take the next message, or return None if none is queued now."""
        head = self.peek()
        if head is not None:
            _, sequence, arrived_ns = self.channel._pop()  # noqa: SLF001
            self._last = (sequence, arrived_ns)
            self.channel.stats.received += 1
        return head

    async def wait(self) -> None:
        """Wait until a message is queued, the bound moves, or the stream ends."""
        await self.channel.wait_changed()

    def __aiter__(self) -> AsyncIterator[T_co]:
        return self

    async def __anext__(self) -> T_co:
        while (message := self.try_receive()) is None:
            if self.has_ended:
                raise StopAsyncIteration
            await self.channel.wait_changed()
        return message

    async def enter_next_epoch(self) -> bool:
        """Leave what is left of this epoch behind; False if the stream ended instead."""
        items = self.channel._items  # noqa: SLF001
        while True:
            while items:
                item, _, _ = self.channel._pop()  # noqa: SLF001
                if isinstance(item, _EpochMark):
                    self.epoch = item.epoch
                    return True
                self.channel.stats.dropped["unread"] += 1
            if self.channel.is_closed:
                return False
            await self.channel.wait_changed()

    def close(self) -> None:
        self.channel.abandon()


class Sender(Generic[T_contra]):
    """The end that an operator writes; every channel that leads from here gets each message."""

    def __init__(self, channels: Sequence[Channel[T_contra]] = ()) -> None:
        self.channels = tuple(channels)

    async def send(self, message: T_contra) -> None:
        """Send one message; waits where a channel blocks.

        Raises:
            ChannelError: If the stream was closed, or a channel with the policy `error` is full.
        """
        for channel in self.channels:
            await channel.put(message)

    def advance(self, bound_ns: int) -> None:
        """Tell receivers that nothing older than `bound_ns` follows, so that joins need not wait."""
        for channel in self.channels:
            channel.advance(bound_ns)

    def start_epoch(self) -> None:
        for channel in self.channels:
            channel.start_epoch()

    def close(self) -> None:
        for channel in self.channels:
            channel.close()
