"""Time as operators see it: of a replay, of the wall, of a test."""

from __future__ import annotations

import math
import time
from typing import Protocol

import anyio

from mapstream.streams.replay_clock import AutoRate, ReplayClock
from mapstream.streams.waiting import Waiters

__all__ = ["AutoRate", "Clock", "ReplayClock", "TestClock", "WallClock"]


class Clock(Protocol):
    """Event time. Sources wait on it; operators never ask the wall."""

    def now_ns(self) -> int:
        """Return the present event time."""
        ...

    async def sleep_until(self, stamp_ns: int) -> None:
        """Wait until event time reaches `stamp_ns`."""
        ...


class WallClock:
    """The clock of a live run."""

    def now_ns(self) -> int:
        return time.time_ns()

    async def sleep_until(self, stamp_ns: int) -> None:
        await anyio.sleep(max(0, stamp_ns - self.now_ns()) / 1e9)


class TestClock:
    """A clock that moves only when told to; no real time passes."""

    __test__ = False  # it is no test case

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._moved = Waiters()
        self._deadlines_ns: list[int] = []

    @property
    def next_deadline_ns(self) -> int | None:
        """The earliest time that somebody waits for."""
        return min(self._deadlines_ns, default=None)

    def now_ns(self) -> int:
        return self._now_ns

    def advance_to(self, stamp_ns: int) -> None:
        """Move to a time, which may not lie before the present."""
        if stamp_ns < self._now_ns:
            raise ValueError(f"a clock cannot go back from {self._now_ns} to {stamp_ns} ns")
        self._now_ns = stamp_ns
        self._moved.wake()

    async def sleep_until(self, stamp_ns: int) -> None:
        self._deadlines_ns.append(stamp_ns)
        try:
            while self._now_ns < stamp_ns:
                await self._moved.wait()
        finally:
            self._deadlines_ns.remove(stamp_ns)

    async def sleep(self, seconds: float) -> None:
        """Wait for a while of this clock's time: what `ReplayClock` may sleep with."""
        await self.sleep_until(self._now_ns + math.ceil(seconds * 1e9))
