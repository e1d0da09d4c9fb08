"""Ending a run early: the first request drains and saves, the second quits."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import anyio
import pytest

from mapstream.graph.report import RunReport
from mapstream.graph.run import run_graph
from mapstream.graph.stop import PATIENCE_S, Stop, on_signals
from tests.graph.made_plans import chain, node
from tests.graph.operators_for_tests import GATES, Collect, Digest, Source, Step

pytestmark = pytest.mark.anyio


async def test_B18_a_request_stops_sources_and_what_is_queued_is_finished(tmp_path: Path) -> None:
    """The source has no end, the step waits at a gate with a full queue; all that was sent is saved."""
    GATES["open"] = anyio.Event()
    stop = Stop()
    reports: list[RunReport] = []
    plan = chain(
        source=node(Source, is_endless=True),
        step=node(Step, gate="open"),
        sink=node(Digest, path=tmp_path / "digest"),
    )

    async def run() -> None:
        reports.append(await run_graph(plan, stop=stop))

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(run)
        await anyio.wait_all_tasks_blocked()
        stop.request()
        await anyio.wait_all_tasks_blocked()
        GATES["open"].set()

    (report,) = reports
    assert report.status == "complete"
    assert report.was_stopped
    sent = report.final.edges[0].sent
    assert sent >= 8
    count = int((tmp_path / "digest").read_text().split()[0])
    assert count == report.final.edges[0].received
    assert sent - count <= 1  # the message that the source still held


async def test_B18_a_second_request_quits_at_once() -> None:
    GATES["open"] = anyio.Event()
    stop = Stop()
    reports: list[RunReport] = []
    plan = chain(
        source=node(Source, is_endless=True), step=node(Step, gate="open"), sink=node(Collect)
    )

    async def run() -> None:
        reports.append(await run_graph(plan, stop=stop))

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(run)
        await anyio.wait_all_tasks_blocked()
        stop.request()
        await anyio.wait_all_tasks_blocked()
        stop.request()

    (report,) = reports
    assert report.status == "failed"
    assert "second request" in report.reasons[0]


_SCRIPT = """
import anyio
from mapstream.graph.run import run_graph
from mapstream.graph.stop import PATIENCE_S, Stop, on_signals
from tests.graph.made_plans import chain, node
from tests.graph.operators_for_tests import Collect, Source, Step

async def main():
    stop = Stop()
    plan = chain(
        source=node(Source, is_endless=True), step=node(Step, "thread", sleep_at=2), sink=node(Collect)
    )
    async with on_signals(stop):
        async with anyio.create_task_group() as tasks:
            async def say():
                await stop.wait_first()
                print("stopping", flush=True)
            tasks.start_soon(say)
            await run_graph(plan, stop=stop)

anyio.run(main)
"""


@pytest.mark.slow
def test_B18_the_second_ctrl_c_quits_though_a_thread_never_returns() -> None:
    root = Path(__file__).parents[2]
    command = [sys.executable, "-c", _SCRIPT]
    with subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "asleep\n"
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "stopping\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 1

    assert PATIENCE_S < 2


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_B18_signals_are_requests(number: signal.Signals) -> None:
    stop = Stop()

    async with on_signals(stop):
        os.kill(os.getpid(), number)
        await stop.wait_first()

    assert stop.is_requested
