"""Waiting on one event loop."""

from __future__ import annotations

import asyncio


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
        except asyncio.CancelledError:
            if future in self:
                self.remove(future)
            raise
