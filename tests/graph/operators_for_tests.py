"""Operators that tests of the runtime put into graphs; importable by the processes it starts."""

from __future__ import annotations

import hashlib
import logging
import os
import signal
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import numpy.typing as npt

from mapstream.operators.operator import (
    NoPorts,
    Operator,
    OperatorConfig,
    context,
    offload,
    pipeline,
    warn,
)
from mapstream.streams.arrays import frozen
from mapstream.streams.channel import Receiver, Sender

COLLECTED: dict[str, list[Any]] = {}  # what each inline `Collect` got, by the operator's name
GATES: dict[str, anyio.Event] = {}  # by name: what an operator waits for until the test says so


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block:
    stamp_ns: int
    value: int = 0
    data: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))  # (N,)

    def __post_init__(self) -> None:
        frozen(self, "data", np.float64, (None,))


@dataclass(frozen=True)
class BlocksIn:
    blocks: Receiver[Block]


@dataclass(frozen=True)
class BlocksOut:
    blocks: Sender[Block]


class SourceConfig(OperatorConfig):
    count: int = 10
    size: int = 1
    period_ns: int = 1_000_000
    epochs: int = 1
    is_paced: bool = False  # wait for the clock
    is_endless: bool = False


class Source(Operator[NoPorts, BlocksOut]):
    """Counts, in equal steps of time."""

    def __init__(self, config: SourceConfig) -> None:
        self._config = config

    async def run(self, inputs: NoPorts, outputs: BlocksOut) -> None:
        config = self._config
        activity = context().activity
        activity.span_ns = (0, (config.count - 1) * config.period_ns)
        for epoch in range(config.epochs):
            if epoch:
                outputs.blocks.start_epoch()
            index = 0
            while index < config.count or config.is_endless:
                stamp_ns = index * config.period_ns
                if config.is_paced:
                    await context().clock.sleep_until(stamp_ns)
                data = np.random.default_rng(index).normal(size=config.size)
                await outputs.blocks.send(Block(stamp_ns=stamp_ns, value=index, data=data))
                activity.position_ns = stamp_ns
                index += 1


class StepConfig(OperatorConfig):
    factor: int = 2
    fail_at: int = -1  # raise at the block with this value
    kill_at: int = -1  # end the process with the signal
    signal: int = signal.SIGKILL
    sleep_at: int = -1  # say so, and never return
    gate: str = ""  # wait for this gate before each block
    log: str = ""


class Step(Operator[BlocksIn, BlocksOut]):
    """Multiplies, where the graph wants it done."""

    def __init__(self, config: StepConfig) -> None:
        self._config = config

    async def run(self, inputs: BlocksIn, outputs: BlocksOut) -> None:
        config = self._config
        if config.log:
            logging.getLogger("tests.step").warning(config.log)
            warn(config.log)
        async for block in inputs.blocks:
            if config.gate:
                await GATES[config.gate].wait()
            await outputs.blocks.send(await offload(self.multiply, block))

    def multiply(self, block: Block) -> Block:
        config = self._config
        if block.value == config.fail_at:
            raise ValueError(f"no {block.value} please")
        if block.value == config.kill_at:
            os.kill(os.getpid(), config.signal)
        if block.value == config.sleep_at:
            sys.stdout.write("asleep\n")
            sys.stdout.flush()
            threading.Event().wait()
        data = block.data * config.factor
        return Block(stamp_ns=block.stamp_ns, value=block.value * config.factor, data=data)


class ManySteps(Operator[BlocksIn, BlocksOut]):
    """Multiplies several blocks at a time, and keeps their order."""

    def __init__(self, config: StepConfig) -> None:
        self._step = Step(config)

    async def run(self, inputs: BlocksIn, outputs: BlocksOut) -> None:
        await pipeline(self._step.multiply, inputs.blocks, outputs.blocks.send)


class SumConfig(OperatorConfig):
    fail_at: int = -1  # raise at the block with this value


class Sum(Operator[BlocksIn, BlocksOut]):
    """Adds up since it was made, so that a new operator shows."""

    def __init__(self, config: SumConfig) -> None:
        self._fail_at = config.fail_at
        self._sum = 0

    async def run(self, inputs: BlocksIn, outputs: BlocksOut) -> None:
        async for block in inputs.blocks:
            if block.value == self._fail_at:
                raise ValueError(f"no {block.value} please")
            self._sum += block.value
            await outputs.blocks.send(Block(stamp_ns=block.stamp_ns, value=self._sum))


class Collect(Operator[BlocksIn, NoPorts]):
    """Keeps what it gets, for the test to look at; reads through all epochs."""

    spans_epochs = True

    async def run(self, inputs: BlocksIn, outputs: NoPorts) -> None:
        kept = COLLECTED.setdefault(context().name, [])
        async for block in inputs.blocks:
            kept.append(block)


class HeadConfig(OperatorConfig):
    count: int = 2


class Head(Operator[BlocksIn, NoPorts]):
    """Returns early."""

    def __init__(self, config: HeadConfig) -> None:
        self._count = config.count

    async def run(self, inputs: BlocksIn, outputs: NoPorts) -> None:
        for _ in range(self._count):
            await anext(inputs.blocks)


class DigestConfig(OperatorConfig):
    path: Path


class Digest(Operator[BlocksIn, NoPorts]):
    """Writes a hash of all that it got when its input ends, wherever it runs."""

    def __init__(self, config: DigestConfig) -> None:
        self._path = config.path

    async def run(self, inputs: BlocksIn, outputs: NoPorts) -> None:
        digest = hashlib.blake2b()
        count = 0
        async for block in inputs.blocks:
            digest.update(
                f"{block.stamp_ns} {block.value} {inputs.blocks.arrival.sequence}".encode()
            )
            digest.update(block.data.tobytes())
            count += 1
        self._path.write_text(f"{count} {digest.hexdigest()}")


@dataclass(frozen=True)
class PairIn:
    a: Receiver[Block]
    b: Receiver[Block] | None = None


class Zip(Operator[PairIn, BlocksOut]):
    """Takes from both inputs in turn, or from `a` alone if `b` is not connected."""

    async def run(self, inputs: PairIn, outputs: BlocksOut) -> None:
        async for a in inputs.a:
            value = a.value
            if inputs.b is not None:
                value += (await anext(inputs.b)).value
            await outputs.blocks.send(Block(stamp_ns=a.stamp_ns, value=value))


class Last(Operator[BlocksIn, BlocksOut]):
    """Sends all blocks once the input has ended."""

    async def run(self, inputs: BlocksIn, outputs: BlocksOut) -> None:
        for block in [block async for block in inputs.blocks]:
            await outputs.blocks.send(block)


class Feedback(Operator[PairIn, BlocksOut]):
    """Sends k+1 after the answer to k came back on `b`, as a loop search waits for corrections."""

    async def run(self, inputs: PairIn, outputs: BlocksOut) -> None:
        answer = 0
        async for a in inputs.a:
            await outputs.blocks.send(Block(stamp_ns=a.stamp_ns, value=a.value + answer))
            assert inputs.b is not None
            answer = (await anext(inputs.b)).value


class Waiting(Operator[PairIn, BlocksOut]):
    """Reads back its own results before it sends any: a deadlock."""

    async def run(self, inputs: PairIn, outputs: BlocksOut) -> None:
        assert inputs.b is not None
        await anext(inputs.b)
