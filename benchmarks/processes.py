"""What a process of its own costs an operator: `python benchmarks/processes.py`.

A message goes to an operator and its result comes back before the next one leaves; the work is the same
where it runs, so the difference is the way there and back. Beside it, the least that two processes can do
with the same memory and a socket pair: copy in, work, copy out, and a byte each way to say so.
"""

from __future__ import annotations

import importlib
import mmap
import os
import socket
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import anyio
import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.graph.plan import Edge, Node, Plan
from mapstream.graph.ring import make_memory
from mapstream.graph.run import run_graph
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload
from mapstream.operators.signature import signature_of
from mapstream.streams.arrays import frozen
from mapstream.streams.channel import Receiver, Sender

NUM_BYTES = 1 << 20
NUM_TRIPS = 300
NUM_WARM = 50  # trips that are not counted
NUM_ROUNDS = 3
TRIPS_S: list[float] = []  # of the last run; the operator that measures is in this process


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Block:
    stamp_ns: int
    data: npt.NDArray[np.float64]  # (N,)

    def __post_init__(self) -> None:
        frozen(self, "data", np.float64, (None,))


@dataclass(frozen=True)
class Inputs:
    blocks: Receiver[Block]


@dataclass(frozen=True)
class Outputs:
    blocks: Sender[Block]


class Trips(Operator[Inputs, Outputs]):
    """Send a block, wait until it is back, and note how long that took."""

    def __init__(self) -> None:
        self._data = np.random.default_rng(0).normal(size=NUM_BYTES // 8)

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        TRIPS_S.clear()
        for number in range(NUM_WARM + NUM_TRIPS):
            started = time.perf_counter()
            await outputs.blocks.send(Block(stamp_ns=number, data=self._data))
            await anext(inputs.blocks)
            TRIPS_S.append(time.perf_counter() - started)


class Double(Operator[Inputs, Outputs]):
    """The work."""

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for block in inputs.blocks:
            await outputs.blocks.send(await offload(self.double, block))

    def double(self, block: Block) -> Block:
        return Block(stamp_ns=block.stamp_ns, data=block.data * 2)


def trip_us(placement: Placement) -> float:
    """Return the median time there and back."""
    parts: tuple[tuple[str, type[Operator[Inputs, Outputs]], Placement], ...] = (
        ("trips", Trips, "inline"),
        ("double", Double, placement),
    )
    nodes = {
        name: Node(
            name=name,
            use=kind.__name__,
            signature=signature_of(kind),
            config=OperatorConfig(),
            placement=where,
        )
        for name, kind, where in parts
    }
    edges = tuple(
        Edge(
            from_node=a, from_port="blocks", to_node=b, to_port="blocks", message_type=Block,
            is_feedback=b == "trips",
        )
        for a, b in (("trips", "double"), ("double", "trips"))
    )  # fmt: skip
    report = anyio.run(lambda: run_graph(Plan(name="trips", nodes=nodes, edges=edges)))
    assert report.status == "complete", report.reasons
    return float(np.median(TRIPS_S[NUM_WARM:])) * 1e6


def bare_us() -> float:
    """Return the median time there and back of two processes that do nothing else."""
    memory = mmap.mmap(make_memory(2 * NUM_BYTES), 0)
    there, back = memoryview(memory)[:NUM_BYTES], memoryview(memory)[NUM_BYTES:]
    ours, theirs = socket.socketpair()
    child = os.fork()
    if child == 0:
        while theirs.recv(1) == b"w":
            back[:] = (np.frombuffer(there) * 2).data.cast("B")
            theirs.send(b"d")
        os._exit(0)
    data = np.random.default_rng(0).normal(size=NUM_BYTES // 8).data.cast("B")
    trips = []
    for _ in range(NUM_WARM + NUM_TRIPS):
        started = time.perf_counter()
        there[:] = data
        ours.send(b"w")
        ours.recv(1)
        trips.append(time.perf_counter() - started)
    ours.send(b"q")
    os.waitpid(child, 0)
    return float(np.median(trips[NUM_WARM:])) * 1e6


def run() -> list[Row]:
    """Measure the way of 1 MB to a process and back, beside the same work inline."""
    bare = min(bare_us() for _ in range(NUM_ROUNDS))
    placements: tuple[Placement, ...] = ("inline", "thread", "process")
    us = {where: min(trip_us(where) for _ in range(NUM_ROUNDS)) for where in placements}
    inline = us["inline"]
    rows = [
        Row(
            what=f"1 MB to an operator and back, {where}",
            ours=f"{us[where]:.0f} us, {us[where] - inline:.0f} us more than the work",
            other=f"inline {inline:.0f} us",
            ratio=us[where] / inline,
            bar="at most 300 us more" if where == "process" else "",
        )
        for where in placements[1:]
    ]
    return [
        *rows,
        Row(
            what="the same against bare processes",
            ours=f"{us['process']:.0f} us",
            other=f"copies and a byte each way {bare:.0f} us",
            ratio=us["process"] / bare,
        ),
    ]


if __name__ == "__main__":
    # By its name: a process of its own cannot import operators from a script.
    print(markdown(importlib.import_module("benchmarks.processes").run()))
