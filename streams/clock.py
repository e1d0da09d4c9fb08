"""Time as operators see it: of a replay, of the wall, of a test."""

from __future__ import annotations

import time
from typing import Protocol

import anyio


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
