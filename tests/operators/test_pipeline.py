"""Calls beside the event loop: several at a time, results in order, each as soon as its turn comes."""

from __future__ import annotations

import threading

import anyio
import anyio.from_thread
import pytest

from mapstream.operators.operator import Context, pipeline, set_context
from mapstream.streams.channel import Channel, Limits, Receiver
from tests.graph.operators_for_tests import Block

pytestmark = pytest.mark.anyio


def threads(workers: int) -> Context:
    return Context(placement="thread", workers=workers, limiter=anyio.CapacityLimiter(workers))


async def filled(count: int) -> Channel[Block]:
    channel: Channel[Block] = Channel(limits=Limits(capacity=count))
    for value in range(count):
        await channel.put(Block(stamp_ns=value, value=value))
    return channel


async def test_a_result_does_not_wait_for_the_next_message() -> None:
    """The input stays open and empty; what was done must come out nevertheless."""
    channel = await filled(3)
    sent: list[int] = []
    all_sent = anyio.Event()

    async def send(value: int) -> None:
        sent.append(value)
        if len(sent) == 3:
            all_sent.set()

    async with anyio.create_task_group() as tasks:
        set_context(threads(4))
        tasks.start_soon(pipeline, lambda block: block.value, Receiver(channel), send)
        await all_sent.wait()
        channel.close()

    assert sent == [0, 1, 2]


async def test_results_keep_their_order_though_the_first_takes_longest() -> None:
    channel = await filled(4)
    channel.close()
    others_done = threading.Barrier(2)
    sent: list[int] = []

    def work(block: Block) -> int:
        if block.value in (0, 3):
            others_done.wait()  # the first call ends when the fourth has begun
        return block.value

    async def send(value: int) -> None:
        sent.append(value)

    set_context(threads(4))
    await pipeline(work, Receiver(channel), send)

    assert sent == [0, 1, 2, 3]


async def test_an_error_is_raised_after_the_results_before_it() -> None:
    channel = await filled(2)
    channel.close()
    second_failed = threading.Event()
    sent: list[int] = []

    def work(block: Block) -> int:
        if block.value == 1:
            second_failed.set()
            raise ValueError("no")
        second_failed.wait()
        return block.value

    async def send(value: int) -> None:
        sent.append(value)

    set_context(threads(2))
    with pytest.raises(ExceptionGroup) as raised:
        await pipeline(work, Receiver(channel), send)

    assert sent == [0]
    assert raised.group_contains(ValueError, match="no")
