"""The queue of a channel: bounded, typed, on one event loop; `channel.py` has its two ends.

A channel is a deque with a limit, a policy for when it is full, and a **time bound**: the least stamp
that may still come. Joins decide by bounds, so a dropped or missing message never starves them.
anyio's own memory streams cost about 10 us a hop, since each call makes a checkpoint; this costs under 1.
Parks (Bounded Scheduling of Process Networks, 1995) shows how blocking channels stay bounded and yet
never deadlock: `grow` is for the runtime that follows him.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import Generic, TypeVar

import anyio.lowlevel

from mapstream.streams.errors import ChannelError
from mapstream.streams.limits import ChannelStats, Entry, Limits, Overflow
from mapstream.streams.messages.sensors import Message
from mapstream.streams.sizes import nbytes
from mapstream.streams.waiting import Waiters

T = TypeVar("T", bound=Message)

_monotonic_ns = time.monotonic_ns
BEGINNING = -(2**63)  # the bound of a channel that has seen nothing


@dataclass(frozen=True, slots=True)
class EpochMark:
    """Stands in the queue where time starts anew."""

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
        self.receivers = Waiters()  # for a message, a bound or the end
        self.readers = Waiters()  # for a message or the end; bounds do not concern them
        self.senders = Waiters()  # for room
        self._overflow = overflow
        self.items: deque[Entry] = deque()
        self._num_bytes = 0
        self._epoch = 0
        self._queued_epoch = 0  # the newest whose mark is not in the overflow
        self.num_marks = 0  # of epochs, in the queue
        # Without byte limit, age limit and overflow, taking a message is a popleft.
        self._is_simple = (
            overflow is None and self.limits.max_bytes is None and self.limits.max_age_ns is None
        )
        self._takes_offers = self._is_simple  # until closed or abandoned
        self.gives_freely = self._is_simple  # while no epoch mark is queued
        self._lateness_ns = self.limits.lateness_ns
        self._max_bytes = self.limits.max_bytes
        if self.limits.policy == "spool" and overflow is None:
            raise ValueError(f"channel {name}: the policy spool needs a place for the overflow")

    def __len__(self) -> int:
        return len(self.items) + (len(self._overflow) if self._overflow else 0)

    @property
    def is_receiver_waiting(self) -> bool:
        return bool(self.receivers or self.readers)

    @property
    def is_sender_waiting(self) -> bool:
        return bool(self.senders)

    @property
    def fill(self) -> float:
        """How full it is: at 1, room is left for one message (or for none, if it holds but one)."""
        fill = (len(self.items) - self.num_marks) / max(1, self.capacity - 1)
        return fill if self._max_bytes is None else max(fill, self._num_bytes / self._max_bytes)

    def _is_full(self) -> bool:
        num_messages = len(self.items) - self.num_marks
        limit = self._max_bytes
        return num_messages >= self.capacity or (
            limit is not None and self._num_bytes >= limit and num_messages > 0
        )

    def _wake_receivers(self) -> None:
        self.receivers.wake()
        self.readers.wake()

    def offer(self, message: T) -> bool:
        """Queue one message if there is plainly room; False if `put` has to wait or to decide."""
        items = self.items
        depth = len(items)
        if depth >= self.capacity or not self._takes_offers:
            return False
        stats = self.stats
        stamp_ns = message.stamp_ns
        bound_ns = stamp_ns - self._lateness_ns  # as `_move_bound`, without a call
        if bound_ns > self.bound_ns:
            self.bound_ns = bound_ns
        else:
            if stamp_ns < self.bound_ns:
                stats.late += 1
            bound_ns = self.bound_ns
        sequence = stats.sent
        stats.sent = sequence + 1
        items.append((message, sequence, _monotonic_ns(), stamp_ns, bound_ns))
        if depth >= stats.high_water:
            stats.high_water = depth + 1
        if self.readers:
            self.readers.wake()
        if self.receivers:
            self.receivers.wake()
        return True

    def _move_bound(self, stamp_ns: int) -> None:
        bound_ns = stamp_ns - self._lateness_ns
        if bound_ns > self.bound_ns:
            self.bound_ns = bound_ns
        elif stamp_ns < self.bound_ns:
            self.stats.late += 1

    async def put(self, message: T) -> None:
        """Queue one message by the channel's policy.

        Raises:
            ChannelError: If the channel is closed, or is full under the policy `error`.
        """
        if self.limits.policy == "block" and not self.is_abandoned and self._is_full():
            started_ns = _monotonic_ns()
            while self._is_full() and not self.is_abandoned:
                await self.senders.wait()
            self.stats.blocked_ns += _monotonic_ns() - started_ns
        if not self.offer(message):
            await self._put_with_care(message)

    async def _put_with_care(self, message: T) -> None:
        """Queue a message where a limit, a policy or the end of the channel has a say."""
        if self.is_closed:
            raise ChannelError(f"{self.name}: a message was sent after the end of the stream")
        stats, stamp_ns = self.stats, message.stamp_ns
        self._move_bound(stamp_ns)
        entry = (message, stats.sent, _monotonic_ns(), stamp_ns, self.bound_ns)
        stats.sent += 1
        if self.is_abandoned:
            stats.dropped["unread"] += 1
            await anyio.lowlevel.checkpoint()  # a sender that never waits must not starve the rest
        elif not (self._overflow or self._is_full()) or await self._make_room(entry):
            self._append(entry)

    async def _make_room(self, entry: Entry) -> bool:
        """Act as a policy says that never waits; True if the message may be queued."""
        policy = self.limits.policy
        if policy != "spool" or self._overflow is None or not self._overflow.put(entry):
            self.stats.dropped["full"] += 1
        if policy == "error":
            raise ChannelError(f"{self.name}: full with {len(self.items)} messages")
        makes_room = policy in ("drop_oldest", "latest")
        while makes_room and self._is_full():
            self._drop_oldest()
        self._wake_receivers()  # the bound moved, even where the message is lost
        await anyio.lowlevel.checkpoint()  # a sender that never waits must not starve the rest
        return makes_room

    def _append(self, entry: Entry) -> None:
        self.items.append(entry)
        if isinstance(entry[0], EpochMark):
            self.num_marks += 1
            self.gives_freely = False
            self._queued_epoch = entry[0].epoch
        if self.limits.max_bytes is not None:
            self._num_bytes += nbytes(entry[0])
        self.stats.high_water = max(self.stats.high_water, len(self.items))
        self._wake_receivers()

    def _drop_oldest(self) -> None:
        """Drop the oldest message, but never the mark of an epoch."""
        at = next(i for i, entry in enumerate(self.items) if not isinstance(entry[0], EpochMark))
        if self.limits.max_bytes is not None:
            self._num_bytes -= nbytes(self.items[at][0])
        del self.items[at]

    def pop(self) -> Entry:
        """Take the head of the queue; for receivers."""
        entry = self.items.popleft()
        if isinstance(entry[0], EpochMark):
            self.num_marks -= 1
            self.gives_freely = self._is_simple and self.num_marks == 0
        if self.limits.max_bytes is not None:
            self._num_bytes -= nbytes(entry[0])
        self._refill()
        self.senders.wake()
        return entry

    def _refill(self) -> None:
        while self._overflow and not self._is_full():
            self._append(self._overflow.get())

    def advance(self, bound_ns: int) -> None:
        """Promise that no message older than `bound_ns` will follow."""
        if bound_ns > self.bound_ns:
            self.bound_ns = bound_ns
            if self.receivers:
                self.receivers.wake()

    def start_epoch(self) -> None:
        """Mark that time starts anew: after a seek, a loop, a jump of the clock."""
        self._epoch += 1
        self.bound_ns = BEGINNING
        if self.is_abandoned:
            return
        mark = (EpochMark(self._epoch), -1, _monotonic_ns(), BEGINNING, BEGINNING)
        if self._overflow:
            self._overflow.put(mark, even_if_full=True)
        else:
            self._append(mark)

    def close(self) -> None:
        """End the stream; the receiver still gets what is queued."""
        self.is_closed = True
        self._takes_offers = False
        self._wake_receivers()

    def abandon(self) -> None:
        """Stop receiving; what is queued and what follows is counted as unread."""
        self.is_abandoned = True
        self._takes_offers = False
        num_marks = self.num_marks + self._epoch - self._queued_epoch
        self.stats.dropped["unread"] += len(self) - num_marks
        self.items.clear()
        self._num_bytes = self.num_marks = 0
        self._queued_epoch = self._epoch
        if self._overflow is not None:
            self._overflow.clear()
        self.senders.wake()

    def grow(self, capacity: int) -> None:
        """Hold more messages: the way out of a deadlock by a full channel (Parks, section 4.2)."""
        self.capacity = capacity
        if self._max_bytes is not None:
            self._max_bytes *= 2
        self.stats.grown += 1
        self._refill()
        self.senders.wake()

    async def wait_changed(self) -> None:
        """Wait until a message, a new bound or the end comes."""
        await self.receivers.wait()
