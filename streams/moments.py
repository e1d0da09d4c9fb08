"""What several sensors saw at one moment."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from typing import TypeVar

from mapstream.streams.channel import Receiver
from mapstream.streams.messages.sensors import Message
from mapstream.streams.sync import merge

M = TypeVar("M", bound=Message)


async def moments(receivers: Sequence[Receiver[M]], within_ns: int) -> AsyncIterator[dict[int, M]]:
    """Yield the messages of each moment by the number of their receiver, in stamp order.

    A moment begins with its oldest message, and has one of a receiver at most. It ends when all are there, or with
    the first message that is newer by more than `within_ns`; so one alone is a moment, too.
    """
    gathered: dict[int, M] = {}
    async for port, message in merge(*receivers):
        first = next(iter(gathered.values()), message)
        is_apart = message.stamp_ns - first.stamp_ns > within_ns
        if gathered and (is_apart or port in gathered):
            yield gathered
            gathered = {}
        gathered[port] = message
        if len(gathered) == len(receivers):
            yield gathered
            gathered = {}
    if gathered:
        yield gathered
