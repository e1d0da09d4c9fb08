"""Waiting for one of several things, on one event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable


class Waiters(list["asyncio.Future[None]"]):
    """Tasks that wait for one thing; each has a future of its own, so that one may be cancelled.

    Plain futures, since creating an `anyio.Event` costs more than the rest of a hop.
    """

    def wake(self) -> None:
        for future in self:
            if not future.done():
                future.set_result(None)
        self.clear()

    async def wait(self) -> None:
        """Wait until these are woken."""
        future = asyncio.get_running_loop().create_future()
        self.append(future)
        try:
            await future
        finally:
            if future in self:  # cancelled
                self.remove(future)

    @staticmethod
    async def wait_any(several: Iterable[Waiters]) -> None:
        """Wait until any of these is woken."""
        future = asyncio.get_running_loop().create_future()
        queues = list(several)
        for queue in queues:
            queue.append(future)
        try:
            await future
        finally:
            for queue in queues:
                if future in queue:
                    queue.remove(future)
