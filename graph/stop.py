"""Ending a run before its sources do: the first request drains and saves, the second quits at once."""

from __future__ import annotations

import faulthandler
import os
import signal
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio

PATIENCE_S = 1.5  # after the second request, before the process ends by force


class Stop:
    """The wish that a run ends."""

    def __init__(self) -> None:
        self._first = anyio.Event()
        self._second = anyio.Event()

    @property
    def is_requested(self) -> bool:
        return self._first.is_set()

    def request(self) -> None:
        """Ask the sources to end, so that what is under way is finished and saved; again: quit at once.

        For the event loop's thread: a signal handler of the loop, an operator, a viewer's callback.
        """
        (self._second if self._first.is_set() else self._first).set()

    async def wait_first(self) -> None:
        await self._first.wait()

    async def wait_second(self) -> None:
        await self._second.wait()


@asynccontextmanager
async def on_signals(stop: Stop) -> AsyncIterator[None]:
    """Within this context Ctrl-C and SIGTERM are requests to stop.

    After the second one the process ends with code 1 even where a thread or C++ code does not return:
    faulthandler's watchdog needs neither the event loop nor the interpreter lock.
    """

    async def listen() -> None:
        with anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
            listening.set()
            async for _ in signals:
                if stop.is_requested:
                    faulthandler.dump_traceback_later(PATIENCE_S, exit=True, file=nowhere)
                stop.request()

    listening = anyio.Event()
    nowhere = os.open(os.devnull, os.O_WRONLY)  # for a traceback that would help nobody
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(listen)
        await listening.wait()
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
            os.close(nowhere)
            tasks.cancel_scope.cancel()
