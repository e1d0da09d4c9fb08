"""Replay through a graph: any rate, pause, step and seek give the same results as no control at all."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import anyio
import anyio.lowlevel
import numpy as np
import pytest

from mapstream.graph.plan import Edge, Plan
from mapstream.graph.progress import describe
from mapstream.graph.report import RunReport
from mapstream.graph.run import run_graph
from mapstream.graph.spec import ClockSpec, ProfileSpec
from mapstream.operators.operator import NoPorts, Operator, context, offload
from mapstream.streams.channel import Arrival, Limits, Sender
from mapstream.streams.clock import Clock, ReplayClock
from tests.graph.made_plans import chain, make_plan, node
from tests.graph.operators_for_tests import (
    COLLECTED,
    Block,
    BlocksIn,
    BlocksOut,
    Collect,
    ManySteps,
    Source,
    Step,
    Sum,
    Zip,
)

pytestmark = pytest.mark.anyio

_PERIOD_NS = 100_000_000
_COUNT = 30


def paced_plan() -> Plan:
    return chain(
        source=node(Source, count=_COUNT, period_ns=_PERIOD_NS, is_paced=True),
        steps=node(ManySteps, "thread", 2),
        sum=node(Sum),
        sink=node(Collect),
    )


class Wall:
    """Real time of a world in which nothing takes any, but for sleeping."""

    def __init__(self) -> None:
        self.now_ns = 0

    async def sleep(self, seconds: float) -> None:
        self.now_ns += math.ceil(max(0.0, seconds) * 1e9)
        await anyio.lowlevel.checkpoint()

    def replay(self, rate: float | None) -> ReplayClock:
        return ReplayClock(rate, monotonic_ns=lambda: self.now_ns, sleep=self.sleep)


def outputs() -> list[tuple[int, int]]:
    return [(block.stamp_ns, block.value) for block in COLLECTED["sink"]]


async def test_B2_the_rate_changes_nothing_but_the_time_it_takes() -> None:
    seen = {}
    for rate in (0.5, 1.0, 4.0, None):
        wall = Wall()
        await _run(paced_plan(), wall.replay(rate))
        seen[rate] = outputs()
        COLLECTED.clear()
        span_ns = (_COUNT - 1) * _PERIOD_NS
        assert wall.now_ns == pytest.approx(span_ns / (rate or math.inf), abs=2 * _COUNT)

    assert len(seen[1.0]) == _COUNT
    assert all(result == seen[1.0] for result in seen.values())


async def test_B3_a_pause_freezes_the_input_and_the_result_is_the_same() -> None:
    wall = Wall()
    clock = wall.replay(1.0)
    paused_at: list[int] = []

    def pause_at_ten(edge: Edge, message: Block, arrival: Arrival) -> None:
        if edge.from_node == "source" and message.value == 10:
            clock.pause()

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(_run, paced_plan(), clock, (pause_at_ten,))
        await anyio.wait_all_tasks_blocked()
        before, frozen_ns = list(outputs()), clock.now_ns()
        wall.now_ns += 5_000_000_000
        await anyio.wait_all_tasks_blocked()
        paused_at += [len(before), len(outputs()), clock.now_ns() - frozen_ns]
        clock.resume()

    assert paused_at == [11, 11, 0]
    paused = outputs()
    COLLECTED.clear()
    await _run(paced_plan(), ReplayClock(None))
    assert paused == outputs()
    assert wall.now_ns == pytest.approx((_COUNT - 1) * _PERIOD_NS + 5_000_000_000, abs=_COUNT)


async def test_B13_a_step_lets_exactly_one_message_pass() -> None:
    clock = ReplayClock(None)
    clock.pause()
    counts = []

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(_run, paced_plan(), clock)
        for _ in range(3):
            await anyio.wait_all_tasks_blocked()
            counts.append(len(COLLECTED["sink"]))
            clock.step()
        await anyio.wait_all_tasks_blocked()
        counts.append(len(COLLECTED["sink"]))
        clock.resume()

    assert counts == [0, 1, 2, 3]
    assert len(outputs()) == _COUNT


class Seeking(Operator[NoPorts, BlocksOut]):
    """Counts, and goes where the clock says."""

    async def run(self, inputs: NoPorts, outputs: BlocksOut) -> None:
        clock = context().clock
        assert isinstance(clock, ReplayClock)
        index = 0
        while index < 10:
            await clock.sleep_until(index * _PERIOD_NS)
            target_ns = clock.take_seek()
            if target_ns is not None:
                index = target_ns // _PERIOD_NS
                outputs.blocks.start_epoch()
                continue
            await outputs.blocks.send(Block(stamp_ns=index * _PERIOD_NS, value=index))
            index += 1


async def test_B13_a_seek_starts_every_operator_anew() -> None:
    clock = ReplayClock(None)
    plan = chain(source=node(Seeking), sum=node(Sum), sink=node(Collect))

    def seek_back(edge: Edge, message: Block, arrival: Arrival) -> None:
        if edge.from_node == "source" and message.value == 6 and arrival.epoch == 0:
            clock.seek(4 * _PERIOD_NS)

    report = await _run(plan, clock, (seek_back,))

    assert report.status == "complete"  # what the old epoch still held is no loss
    sums = [value for _, value in outputs()]
    assert sums[-6:] == [4, 9, 15, 22, 30, 39]  # sums from 4 on, by a new operator
    assert sums[:3] == [0, 1, 3]


@dataclass(frozen=True)
class Rates:
    imu: Sender[Block]
    lidar: Sender[Block]
    camera: Sender[Block]
    gnss: Sender[Block]


@dataclass(frozen=True)
class PairOut:
    a: Sender[Block]
    b: Sender[Block]


class Robot(Operator[NoPorts, Rates]):
    """Four sensors of different rates; each message comes when its delay is over, not when it was true."""

    sensors = {  # noqa: RUF012  # period, delay [ms]
        "imu": (5, 0),
        "lidar": (100, 500),
        "camera": (50, 120),
        "gnss": (1000, 2000),
    }

    async def run(self, inputs: NoPorts, outputs: Rates) -> None:
        events = sorted(
            (stamp_ms + delay_ms, port, stamp_ms)
            for port, (period_ms, delay_ms) in self.sensors.items()
            for stamp_ms in range(0, 4000, period_ms)
        )
        for arrival_ms, port, stamp_ms in events:
            await context().clock.sleep_until(arrival_ms * 1_000_000)
            block = Block(stamp_ns=stamp_ms * 1_000_000, value=stamp_ms)
            await getattr(outputs, port).send(block)


async def test_B8_sensors_of_different_rates_and_delays_lose_nothing() -> None:
    ports = list(Robot.sensors)
    plan = make_plan(
        {"robot": node(Robot)}
        | {p: node(Step, factor=1) for p in ports}
        | {f"{p}_sink": node(Collect) for p in ports},
        *(f"robot.{p} -> {p}.blocks" for p in ports),
        *(f"{p}.blocks -> {p}_sink.blocks" for p in ports),
        limits=Limits(capacity=2),
    )

    report = await _run(plan, ReplayClock(None))

    assert report.status == "complete"
    counts = {port: len(COLLECTED[f"{port}_sink"]) for port in ports}
    assert counts == {"imu": 800, "lidar": 40, "camera": 80, "gnss": 4}


class Slow(Operator[BlocksIn, BlocksOut]):
    """Works on each message for a while, in a thread."""

    async def run(self, inputs: BlocksIn, outputs: BlocksOut) -> None:
        async for block in inputs.blocks:
            await outputs.blocks.send(await offload(self.work, block))

    def work(self, block: Block) -> Block:
        for _ in range(100):
            np.sort(np.random.default_rng(block.value).normal(size=300))
        return block


async def test_B12_auto_rate_goes_as_fast_as_the_slowest_operator_and_drops_nothing() -> None:
    """Edges that would drop when full hold less than they could, at a rate that nobody chose."""
    count = 200
    plan = make_plan(
        {
            "source": node(Source, count=count, period_ns=_PERIOD_NS, is_paced=True),
            "slow": node(Slow, "thread"),
            "sink": node(Collect),
        },
        "source.blocks -> slow.blocks",
        "slow.blocks -> sink.blocks",
        limits=Limits(policy="drop_oldest", capacity=8),
    )
    plan = replace(plan, profile=ProfileSpec(clock=ClockSpec(rate="auto")))

    report = await run_graph(plan)

    edge = report.final.edges[0]
    assert len(outputs()) == count
    assert (report.status, edge.num_lost) == ("complete", 0)
    assert edge.high_water < edge.capacity
    assert report.final.auto_rate is not None
    assert report.final.auto_rate > 2.0
    assert f"automatic rate {report.final.auto_rate:.1f} x" in describe(report.final)


class Lagging(Operator[NoPorts, PairOut]):
    """Sends on `b` long after `a` what belongs together, at the pace of the clock."""

    async def run(self, inputs: NoPorts, outputs: PairOut) -> None:
        for index in range(100):
            stamp_ns = index * _PERIOD_NS
            await context().clock.sleep_until(stamp_ns)
            await outputs.a.send(Block(stamp_ns=stamp_ns, value=index))
            if index >= 50:
                await outputs.b.send(Block(stamp_ns=stamp_ns - 50 * _PERIOD_NS, value=index))


async def test_B12_auto_rate_does_not_wait_for_a_join_that_waits_for_the_source() -> None:
    plan = make_plan(
        {"source": node(Lagging), "zip": node(Zip), "sink": node(Collect)},
        "source.a -> zip.a",
        "source.b -> zip.b",
        "zip.blocks -> sink.blocks",
        limits=Limits(capacity=4),
    )
    plan = replace(plan, profile=ProfileSpec(clock=ClockSpec(rate="auto")))

    with anyio.fail_after(120):  # rather than forever
        report = await run_graph(plan)

    assert len(outputs()) == 50
    assert report.final.edges[0].grown > 0


async def _run(plan: Plan, clock: Clock, taps: tuple[object, ...] = ()) -> RunReport:
    return await run_graph(plan, clock=clock, taps=taps)  # type: ignore[arg-type]  # functions of the tests
