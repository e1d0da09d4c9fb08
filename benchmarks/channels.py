"""One hop of a channel against `asyncio.Queue` and anyio's memory streams: `python benchmarks/channels.py`.

A channel counts, numbers, stamps and bounds each message, which the others do not. Each figure is the least
of many short rounds in which the sides take turns, since other work on the machine only ever adds.
"""

from __future__ import annotations

import asyncio
import math
import sys
import time
from collections.abc import Callable, Coroutine
from pathlib import Path

import anyio

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.streams.channel import Channel, Limits, Receiver, Sender

NUM_MESSAGES = 1000
NUM_ROUNDS = 60


class Tick:
    """The smallest message."""

    __slots__ = ("stamp_ns",)

    def __init__(self, stamp_ns: int) -> None:
        self.stamp_ns = stamp_ns


TICKS = [Tick(i) for i in range(NUM_MESSAGES)]


async def channel_hop(capacity: int, branches: int) -> float:
    channels: list[Channel[Tick]] = [
        Channel(limits=Limits(capacity=capacity)) for _ in range(branches)
    ]
    sender = Sender(channels)

    async def produce() -> None:
        for tick in TICKS:
            await sender.send(tick)
        sender.close()

    async def consume(channel: Channel[Tick]) -> None:
        async for _ in Receiver(channel):
            pass

    return await timed(produce, *(lambda c=c: consume(c) for c in channels))


async def queue_hop(capacity: int, branches: int) -> float:
    queues: list[asyncio.Queue[Tick | None]] = [asyncio.Queue(capacity) for _ in range(branches)]

    async def produce() -> None:
        for tick in (*TICKS, None):
            for queue in queues:
                await queue.put(tick)

    async def consume(queue: asyncio.Queue[Tick | None]) -> None:
        while await queue.get() is not None:
            pass

    return await timed(produce, *(lambda q=q: consume(q) for q in queues))


async def stream_hop(capacity: int, branches: int) -> float:
    streams = [anyio.create_memory_object_stream[Tick](capacity) for _ in range(branches)]

    async def produce() -> None:
        for tick in TICKS:
            for stream, _ in streams:
                await stream.send(tick)
        for stream, _ in streams:
            stream.close()

    async def consume(number: int) -> None:
        async with streams[number][1] as stream:
            async for _ in stream:
                pass

    return await timed(produce, *(lambda n=n: consume(n) for n in range(branches)))


async def timed(*tasks: Callable[[], Coroutine[None, None, None]]) -> float:
    """Return the time per message [us] until all tasks are done."""
    started = time.perf_counter()
    async with asyncio.TaskGroup() as group:
        for task in tasks:
            group.create_task(task())
    return (time.perf_counter() - started) / NUM_MESSAGES * 1e6


async def compare(what: str, capacity: int, branches: int = 1) -> list[Row]:
    hops = {"ours": channel_hop, "asyncio.Queue": queue_hop, "anyio stream": stream_hop}
    least = dict.fromkeys(hops, math.inf)
    for _ in range(NUM_ROUNDS):
        for name, hop in hops.items():
            least[name] = min(least[name], await hop(capacity, branches))
    ours = least.pop("ours")
    return [
        Row(
            what=what,
            ours=f"{ours:.2f} us",
            other=f"{name} {theirs:.2f} us",
            ratio=ours / theirs,
            bar="at most 0.5, and 2 us" if name == "asyncio.Queue" and branches == 1 else "",
        )
        for name, theirs in least.items()
    ]


def run() -> list[Row]:
    """Measure a hop without waiting, with the default capacity, and a fan-out."""

    async def measure() -> list[Row]:
        return [
            *await compare("hop, capacity 256", 256),
            *await compare("hop, capacity 8: tasks wait every 8 messages", 8),
            *await compare("to 4 readers, capacity 256", 256, branches=4),
        ]

    return anyio.run(measure)


if __name__ == "__main__":
    print(markdown(run()))
