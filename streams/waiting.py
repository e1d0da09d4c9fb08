"""Waiting for one of several things, on one event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable


class Waiters:
    """Tasks that wait for one thing; each has a future of its own, so that one may be cancelled.

    Plain futures, since creating an `anyio.Event` costs more than the rest of a hop.
    """

    __slots__ = ("futures",)

    def __init__(self) -> None:
        self.futures: list[asyncio.Future[None]] = []

    def __bool__(self) -> bool:
        return bool(self.futures)

    def wake(self) -> None:
        for future in self.futures:
            if not future.done():
                future.set_result(None)
        self.futures.clear()

    @staticmethod
    async def wait_any(several: Iterable[Waiters]) -> None:
        """Wait until any of these is woken."""
        future = asyncio.get_running_loop().create_future()
        queues = [waiters.futures for waiters in several]
        for queue in queues:
            queue.append(future)
        try:
            await future
        finally:
            for queue in queues:
                if future in queue:
                    queue.remove(future)
