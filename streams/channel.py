"""The two ends of a channel: what an operator reads and what it writes."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Sequence
from typing import Generic, TypeVar

from mapstream.streams.limits import Arrival, ChannelStats, Entry, Limits, Overflow, Policy
from mapstream.streams.messages.sensors import Message
from mapstream.streams.queue import BEGINNING, Channel, EpochMark
from mapstream.streams.waiting import Waiters

__all__ = [
    "BEGINNING",
    "Arrival",
    "Channel",
    "ChannelStats",
    "Limits",
    "Overflow",
    "Policy",
    "Receiver",
    "Sender",
    "Waiters",
]

T_co = TypeVar("T_co", bound=Message, covariant=True)
T_contra = TypeVar("T_contra", bound=Message, contravariant=True)
_monotonic_ns = time.monotonic_ns


class Receiver(Generic[T_co]):
    """The end of a channel that an operator reads.

    Iteration ends with the stream, and at the end of an epoch: then the runtime starts the operator
    anew. A receiver with `spans_epochs` reads on, and `arrival.epoch` says where it is.
    """

    def __init__(self, channel: Channel[T_co], *, spans_epochs: bool = False) -> None:
        self.channel = channel
        self.spans_epochs = spans_epochs
        self.epoch = 0
        self._last: Entry = (None, -1, 0, BEGINNING, BEGINNING)

    @property
    def bound_ns(self) -> int:
        """The least stamp that a message may still have, those in the queue included."""
        items = self.channel.items  # the two ends are one mechanism
        return items[0][4] if items else self.channel.bound_ns

    @property
    def is_at_epoch_end(self) -> bool:
        """True if nothing more comes before the next epoch, or at all."""
        items = self.channel.items
        return isinstance(items[0][0], EpochMark) if items else self.channel.is_closed

    @property
    def has_ended(self) -> bool:
        """True if nothing more comes for this receiver."""
        if self.spans_epochs and self.channel.items:
            return False
        return self.is_at_epoch_end

    @property
    def arrival(self) -> Arrival:
        """Circumstances of the message that was taken last."""
        _, sequence, arrived_ns, _, bound_ns = self._last
        return Arrival(sequence, arrived_ns, self.epoch, bound_ns)

    @property
    def last_stamp_ns(self) -> int | None:
        """Stamp of the message taken last; None before the first."""
        return None if self._last[1] < 0 else self._last[3]

    def peek(self) -> T_co | None:
        """Return the next message without taking it, or None if none is queued now."""
        return self._peek(crosses_epochs=self.spans_epochs)

    def _peek(self, *, crosses_epochs: bool) -> T_co | None:
        """Drop what is too old, and cross into the next epoch if that is wanted."""
        channel = self.channel
        items, max_age_ns = channel.items, channel.limits.max_age_ns
        while items:
            head: T_co | EpochMark = items[0][0]
            if isinstance(head, EpochMark):
                if not crosses_epochs:
                    return None
                self.epoch = head.epoch
            elif max_age_ns is not None and _monotonic_ns() - items[0][2] > max_age_ns:
                channel.stats.dropped["age"] += 1
            else:
                return head
            channel.pop()
        return None

    def try_receive(self) -> T_co | None:
        """Take the next message, or return None if none is queued now."""
        return self._take(self.peek())

    def try_receive_in_epoch(self) -> T_co | None:
        """Like `try_receive`, but stop at the end of an epoch even if this receiver spans epochs."""
        return self._take(self._peek(crosses_epochs=False))

    def _take(self, head: T_co | None) -> T_co | None:
        if head is not None:
            self._last = self.channel.pop()
            self.channel.stats.received += 1
        return head

    def cross_epoch(self) -> bool:
        """Step over the mark between two epochs; False if none is next."""
        items = self.channel.items
        mark = items[0][0] if items else None
        if not isinstance(mark, EpochMark):
            return False
        self.epoch = mark.epoch
        self.channel.pop()
        return True

    async def wait(self) -> None:
        """Wait until a message is queued, the bound moves, or the stream ends."""
        await self.channel.wait_changed()

    def __aiter__(self) -> AsyncIterator[T_co]:
        return self

    async def __anext__(self) -> T_co:
        channel = self.channel
        items = channel.items
        while True:
            if items and channel.gives_freely:
                self._last = entry = items.popleft()
                channel.stats.received += 1
                if channel.senders:
                    channel.senders.wake()
                message: T_co = entry[0]
                return message
            if not items and not channel.is_closed:
                await channel.readers.wait()
                continue
            found = self.try_receive()
            if found is not None:
                return found
            if self.has_ended:
                raise StopAsyncIteration
            await channel.readers.wait()

    async def enter_next_epoch(self) -> bool:
        """Leave what is left of this epoch behind; False if the stream ended instead."""
        channel = self.channel
        while True:
            while not self.is_at_epoch_end and channel.items:
                channel.pop()
                channel.stats.dropped["unread"] += 1
            if self.cross_epoch():
                return True
            if channel.is_closed:
                return False
            await channel.readers.wait()

    def close(self) -> None:
        """Receive nothing more; what is queued and what follows is counted as unread."""
        self.channel.abandon()


class Sender(Generic[T_contra]):
    """The end that an operator writes; every channel that leads from here gets each message."""

    def __init__(self, channels: Sequence[Channel[T_contra]] = ()) -> None:
        self.channels = tuple(channels)

    @property
    def is_connected(self) -> bool:
        """False if nobody will read, so that costly messages need not be made."""
        return bool(self.channels)

    async def send(self, message: T_contra) -> None:
        """Send one message; waits where a channel blocks.

        Raises:
            ChannelError: If the stream was closed, or a channel with the policy `error` is full.
        """
        for channel in self.channels:
            if not channel.offer(message):
                await channel.put(message)

    def advance(self, bound_ns: int) -> None:
        """Tell receivers that nothing older than `bound_ns` follows, so that joins need not wait."""
        for channel in self.channels:
            channel.advance(bound_ns)

    def start_epoch(self) -> None:
        """Mark that time starts anew."""
        for channel in self.channels:
            channel.start_epoch()

    def close(self) -> None:
        """End the stream."""
        for channel in self.channels:
            channel.close()
