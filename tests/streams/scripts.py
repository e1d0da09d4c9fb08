"""Streams to put into joins: what each port sends, and in which order the ports take turns."""

from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from typing import Any

import anyio
import anyio.lowlevel
from hypothesis import strategies as st

from mapstream.streams.channel import Channel, Limits, Receiver

MAX_LATENESS_NS = 5


@dataclass(frozen=True, slots=True)
class Tick:
    """A message that is told apart by its number."""

    stamp_ns: int
    number: int = 0


@dataclass(frozen=True, slots=True)
class Advance:
    """A bound without a message: what was dropped, or what never was."""

    bound_ns: int


Script = tuple[Tick | Advance, ...]


@st.composite
def scripts(draw: st.DrawFn, *, max_size: int = 12) -> Script:
    """Return what one port sends: stamps that increase up to the lateness, and bounds between."""
    steps = draw(st.lists(st.tuples(st.integers(0, 12), st.integers(0, 9)), max_size=max_size))
    now_ns, script = 0, list[Tick | Advance]()
    for number, (step_ns, kind) in enumerate(steps):
        now_ns += step_ns
        if kind == 0:
            script.append(Advance(now_ns - MAX_LATENESS_NS))
        else:
            behind_ns = MAX_LATENESS_NS if kind == 1 else 0
            script.append(Tick(now_ns - behind_ns, number))
    return tuple(script)


def ticks(*stamps_ns: int) -> Script:
    return tuple(Tick(stamp_ns, number) for number, stamp_ns in enumerate(stamps_ns))


async def play(
    join: Callable[..., AsyncIterator[Any]], port_scripts: Sequence[Script], turns: Sequence[int]
) -> list[Any]:
    """Return what a join of all ports yields if they send in these turns and then end.

    Between two turns the join runs until it waits. Turns of ports that have ended go to the others.
    """
    limits = Limits(capacity=10_000, lateness_ns=MAX_LATENESS_NS)
    channels: list[Channel[Tick]] = [Channel(f"p{i}", limits) for i in range(len(port_scripts))]
    found: list[Any] = []

    async def collect() -> None:
        found.extend([item async for item in join(*map(Receiver, channels))])

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(collect)
        left = {i: list(script) for i, script in enumerate(port_scripts)}
        for turn in turns:
            if left:
                await _take_turn(channels, left, sorted(left)[turn % len(left)])
        while left:
            await _take_turn(channels, left, min(left))
    return found


async def _take_turn(
    channels: Sequence[Channel[Tick]], left: dict[int, list[Tick | Advance]], port: int
) -> None:
    if not left[port]:
        channels[port].close()
        del left[port]
    else:
        step = left[port].pop(0)
        if isinstance(step, Tick):
            await channels[port].put(step)
        else:
            channels[port].advance(step.bound_ns)
    for _ in range(3):
        await anyio.lowlevel.checkpoint()
