"""The ends of channels in a process of its own: what a receiver, a sender and a clock are there.

The channels with their policies and bounds are the parent's; on this side are a message or two, and
credits say how many. `remote.py` is the other end.
"""

from __future__ import annotations

import struct
from typing import Any

import anyio

from mapstream.graph.packing import pack
from mapstream.graph.pipe import Frame, Pipe
from mapstream.graph.ring import RingReader, RingWriter
from mapstream.streams.channel import Channel, Limits, Sender
from mapstream.streams.errors import ChannelError
from mapstream.streams.limits import Entry
from mapstream.streams.waiting import Waiters

CREDITS = 2  # messages of an input that may be on the other side: one at work, one next
CREDITS_BACK = (
    4  # messages of an output that may be on this side before room is made; given in pairs
)
ARRIVAL = struct.Struct("<qqq")  # sequence, arrival, bound
STAMP = struct.Struct("<q")


class Inlet(Channel[Any]):
    """What came through the pipe; each message that is taken gives leave to send another."""

    def __init__(self, name: str, number: int, pipe: Pipe, ring: RingReader) -> None:
        super().__init__(name, Limits(capacity=CREDITS))
        self.gives_freely = self._is_simple = False  # so that each taking passes `pop`
        self._number = number
        self._pipe = pipe
        self._ring = ring

    def deliver(self, message: Any, arrival: tuple[int, int, int]) -> None:  # noqa: ANN401
        """Queue a message as it was queued at the parent."""
        sequence, arrived_ns, self.bound_ns = arrival
        self.stats.sent += 1
        self._append((message, sequence, arrived_ns, message.stamp_ns, self.bound_ns))

    def pop(self) -> Entry:
        entry = super().pop()
        if entry[1] >= 0:  # not the mark of an epoch
            self._ring.note(self._number, entry[3])
            self._pipe.send(Frame.CREDIT, self._number, lazily=True)
        return entry

    def abandon(self) -> None:
        super().abandon()
        self._pipe.send(Frame.ABANDON, self._number)


class Outlet(Sender[Any]):
    """Sends through the pipe, as far as the parent has room."""

    def __init__(self, number: int, pipe: Pipe, ring: RingWriter) -> None:
        super().__init__()
        self._number = number
        self._pipe = pipe
        self._ring = ring
        self._is_closed = False
        self._credits = CREDITS_BACK
        self.room = Waiters()

    @property
    def is_connected(self) -> bool:
        return True  # outputs that nobody reads have no outlet

    async def send(self, message: Any) -> None:  # noqa: ANN401  # of any channel
        if self._is_closed:
            raise ChannelError("a message was sent after the end of the stream")
        while self._credits == 0:
            await self.room.wait()
        self._credits -= 1
        self._pipe.send(Frame.MESSAGE, self._number, pack(message, self._ring))

    def add_credits(self, count: int) -> None:
        self._credits += count
        self.room.wake()

    def advance(self, bound_ns: int) -> None:
        self._pipe.send(Frame.BOUND, self._number, STAMP.pack(bound_ns), lazily=True)

    def start_epoch(self) -> None:
        self._pipe.send(Frame.EPOCH, self._number)

    def close(self) -> None:
        if not self._is_closed:
            self._is_closed = True
            self._pipe.send(Frame.CLOSE, self._number)


class ParentClock:
    """Event time as the parent tells it."""

    def __init__(self, pipe: Pipe) -> None:
        self._pipe = pipe
        self._now_ns = 0
        self._num_sleeps = 0
        self._sleepers: dict[int, anyio.Event] = {}

    @property
    def has_sleepers(self) -> bool:
        return bool(self._sleepers)

    def now_ns(self) -> int:
        """Return the event time at which the parent last woke somebody here."""
        return self._now_ns

    async def sleep_until(self, stamp_ns: int) -> None:
        self._num_sleeps = number = (self._num_sleeps + 1) % 2**16
        woken = self._sleepers[number] = anyio.Event()
        self._pipe.send(Frame.SLEEP, number, STAMP.pack(stamp_ns))
        try:
            await woken.wait()
        finally:
            del self._sleepers[number]

    def wake(self, number: int, now_ns: int) -> None:
        self._now_ns = now_ns
        if number in self._sleepers:
            self._sleepers[number].set()
