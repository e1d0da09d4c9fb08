"""Operators in processes of their own behave as inline, and their deaths are told, never waited for."""

from __future__ import annotations

import gc
import logging
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import anyio
import pytest

from mapstream.graph.plan import Edge, Plan
from mapstream.graph.report import RunReport
from mapstream.graph.run import run_graph
from mapstream.graph.spec import OnErrorSpec
from mapstream.graph.stop import Stop
from mapstream.operators.operator import Placement
from mapstream.streams.channel import Arrival, Limits
from tests.graph.made_plans import chain, make_plan, node
from tests.graph.operators_for_tests import (
    COLLECTED,
    Block,
    Collect,
    Digest,
    Feedback,
    Head,
    Last,
    Source,
    Step,
    Sum,
    Waiting,
    Zip,
)

# Each test starts an interpreter or two.
pytestmark = [pytest.mark.anyio, pytest.mark.slow]


@pytest.fixture(autouse=True)
def _nothing_left_behind() -> Iterator[None]:
    """After each test: no process, nothing new in /dev/shm, no descriptor that stays open."""
    gc.collect()
    shared, open_before = _shared_memory(), _num_open()
    yield
    COLLECTED.clear()
    gc.collect()
    assert not _children()
    assert _shared_memory() <= shared
    assert _num_open() <= open_before


def _shared_memory() -> set[str]:
    folder = Path("/dev/shm")  # noqa: S108  # looked at, not written
    return {path.name for path in folder.iterdir()} if folder.exists() else set()


def _num_open() -> int:
    folder = Path("/proc/self/fd")
    return len(list(folder.iterdir())) if folder.exists() else 0


def _children() -> list[str]:
    tasks = Path(f"/proc/{os.getpid()}/task")
    if not tasks.exists():
        return []
    return [c for task in tasks.iterdir() for c in (task / "children").read_text().split()]


def values(name: str = "sink") -> list[int]:
    return [block.value for block in COLLECTED[name]]


async def test_B14_a_process_changes_nothing(tmp_path: Path) -> None:
    """Source, transform and sink each in a process: the same bytes, stamps and sequence as inline."""

    def plan(placement: Placement) -> Plan:
        return chain(
            source=node(Source, placement, count=40, size=5000),
            step=node(Step, placement),
            sink=node(Digest, placement, path=tmp_path / placement),
        )

    inline = await run_graph(plan("inline"))
    process = await run_graph(plan("process"))

    assert inline.status == process.status == "complete"
    assert (tmp_path / "process").read_text() == (tmp_path / "inline").read_text()
    assert (tmp_path / "inline").read_text().startswith("40 ")


async def test_arrays_come_back_read_only_and_keep_their_values_while_held() -> None:
    plan = chain(
        source=node(Source, count=60, size=5000), step=node(Step, "process"), sink=node(Collect)
    )

    await run_graph(plan)

    inline = chain(source=node(Source, count=60, size=5000), step=node(Step), other=node(Collect))
    await run_graph(inline)
    pairs = zip(COLLECTED["sink"], COLLECTED["other"], strict=True)
    assert all(a.data.tobytes() == b.data.tobytes() for a, b in pairs)
    assert not any(block.data.flags.writeable for block in COLLECTED["sink"])


async def test_epochs_cross_and_make_new_operators_there() -> None:
    await run_graph(
        chain(source=node(Source, count=4, epochs=3), sum=node(Sum, "process"), sink=node(Collect))
    )

    assert values() == [0, 1, 3, 6] * 3


async def test_an_error_there_is_told_as_here() -> None:
    report = await run_graph(
        chain(
            source=node(Source, count=50), step=node(Step, "process", fail_at=4), sink=node(Collect)
        )
    )

    assert report.status == "failed"
    (error,) = report.errors
    assert "operator 'step' (Step) failed after blocks at stamp_ns 4000000" in str(error)
    assert "ValueError: no 4 please" in str(error)
    assert "in multiply" in error.__notes__[0]  # where, in the process
    assert values() == [0, 2, 4, 6]


async def test_skip_works_there() -> None:
    step = node(Step, "process", fail_at=4, on_error=OnErrorSpec(do="skip"))

    report = await run_graph(chain(source=node(Source), step=step, sink=node(Collect)))

    assert report.status == "lossy"
    assert values() == [2 * i for i in range(10) if i != 4]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGABRT])
async def test_a_killed_process_is_its_operators_error(
    number: signal.Signals, tmp_path: Path
) -> None:
    """And the sink still saves what came before."""
    plan = chain(
        source=node(Source, count=50),
        step=node(Step, "process", kill_at=4, signal=number),
        sink=node(Digest, path=tmp_path / "digest"),
    )

    report = await run_graph(plan)

    assert report.status == "failed"
    assert f"was ended by {number.name}" in report.reasons[0]
    assert "'step' (Step) failed after blocks at stamp_ns 4000000" in report.reasons[0]
    assert (tmp_path / "digest").read_text().startswith("4 ")


async def test_a_killed_process_is_restarted_if_the_graph_says_so() -> None:
    step = node(Step, "process", kill_at=4, on_error=OnErrorSpec(do="restart", backoff_s=0))

    report = await run_graph(chain(source=node(Source), step=step, sink=node(Collect)))

    assert report.status == "lossy"
    assert values()[:4] == [0, 2, 4, 6]
    assert values()[-1] == 18
    assert 8 not in values()


async def test_returning_early_there_stops_the_source_here() -> None:
    report = await run_graph(
        chain(source=node(Source, is_endless=True), head=node(Head, "process"))
    )

    assert report.status == "complete"


async def test_B18_a_source_there_is_stopped_and_what_it_sent_arrives() -> None:
    stop = Stop()

    def stop_soon(edge: Edge, message: Block, arrival: Arrival) -> None:
        if message.value == 20 and not stop.is_requested:
            stop.request()

    report = await run_graph(
        chain(source=node(Source, "process", is_endless=True), sink=node(Collect)),
        stop=stop,
        taps=[stop_soon],
    )

    assert report.status == "complete"
    assert values() == list(range(len(values())))
    assert len(values()) > 20


async def test_B18_a_second_request_ends_a_process_that_works() -> None:
    stop = Stop()
    reports: list[RunReport] = []
    plan = chain(source=node(Source), stuck=node(Step, "process", sleep_at=0), sink=node(Collect))

    async def run() -> None:
        reports.append(await run_graph(plan, stop=stop))

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(run)
        await anyio.wait_all_tasks_blocked()
        stop.request()
        await anyio.wait_all_tasks_blocked()
        stop.request()

    assert reports[0].status == "failed"


async def test_warnings_logs_and_activity_come_back(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        report = await run_graph(
            chain(
                source=node(Source, count=30),
                step=node(Step, "process", log="take care"),
                sink=node(Collect),
            )
        )

    assert report.warnings == ("step: take care (1 times)",)
    assert ("tests.step", logging.WARNING, "take care") in caplog.record_tuples
    step = report.final.operators[1]
    assert step.num_calls == 30
    assert step.rss_bytes is not None
    assert step.rss_bytes > 10_000_000
    assert step.cpu_s > 0


async def test_growing_and_feedback_work_across_processes() -> None:
    """The watch knows that an operator in a process waits, and for what."""
    plan = make_plan(
        {
            "source": node(Source, count=40),
            "last": node(Last, "process"),
            "zip": node(Zip, "process"),
            "loops": node(Feedback),
            "sum": node(Sum, "process"),
            "sink": node(Collect),
        },
        "source.blocks -> last.blocks",
        "source.blocks -> zip.a",
        "last.blocks -> zip.b",
        "zip.blocks -> loops.a",
        "loops.blocks -> sum.blocks",
        "feedback sum.blocks -> loops.b",
        "loops.blocks -> sink.blocks",
        limits=Limits(capacity=2),
    )

    report = await run_graph(plan)

    assert report.status == "complete"
    assert len(values()) == 40
    assert [e.name for e in report.final.edges if e.grown] == ["source.blocks -> zip.a"]


async def test_a_deadlock_across_processes_is_reported() -> None:
    plan = make_plan(
        {"source": node(Source), "stuck": node(Waiting, "process"), "step": node(Step)},
        "source.blocks -> stuck.a",
        "stuck.blocks -> step.blocks",
        "feedback step.blocks -> stuck.b",
    )

    report = await run_graph(plan)

    assert report.status == "failed"
    assert "stuck waits for a message of step.blocks -> stuck.b" in report.reasons[0]


async def test_an_operator_that_cannot_be_imported_there_is_refused_with_the_way_out() -> None:
    class Local(Sum):
        pass

    report = await run_graph(
        chain(source=node(Source), local=node(Local, "process"), sink=node(Collect))
    )

    assert report.status == "failed"
    assert "cannot run in a process of its own" in report.reasons[0]
    assert "run: thread" in report.reasons[0]
