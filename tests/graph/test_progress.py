"""What somebody sees of a run: where it is, how fast, what limits it."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from mapstream.graph.metrics import Snapshot
from mapstream.graph.progress import ProgressBar, describe, fraction_done
from mapstream.graph.run import run_graph
from mapstream.graph.trace import TraceFile
from mapstream.streams.channel import Limits
from tests.graph.made_plans import chain, make_plan, node
from tests.graph.operators_for_tests import Collect, Source, Step

pytestmark = pytest.mark.anyio


async def last_snapshot() -> Snapshot:
    report = await run_graph(
        chain(source=node(Source, count=5), step=node(Step), sink=node(Collect))
    )
    return report.final


async def test_P7_a_line_says_speed_and_what_limits() -> None:
    snapshot = await last_snapshot()

    text = describe(snapshot)

    assert fraction_done(snapshot) == 1.0
    assert f"{snapshot.speed:.1f} x real time, limited by {snapshot.limiting} (" in text
    assert "dropped" not in text


async def test_drops_are_shown() -> None:
    plan = make_plan(
        {"source": node(Source, count=50), "sink": node(Collect)},
        "source.blocks -> sink.blocks",
        limits=Limits(policy="drop_newest", capacity=1),
    )

    snapshot = (await run_graph(plan)).final

    assert snapshot.num_lost > 0
    assert f"{snapshot.num_lost} dropped" in describe(snapshot)


async def test_P7_a_trace_has_a_line_per_snapshot(tmp_path: Path) -> None:
    plan = chain(source=node(Source, count=5), step=node(Step), sink=node(Collect))

    with TraceFile(tmp_path / "trace.jsonl") as trace:
        report = await run_graph(plan, on_progress=trace)

    lines = (tmp_path / "trace.jsonl").read_text().splitlines()
    last = json.loads(lines[-1])
    assert last["limiting"] == report.final.limiting
    assert [edge["sent"] for edge in last["edges"]] == [5, 5]
    assert last["operators"][1]["num_calls"] == 5


@pytest.mark.parametrize("is_terminal", [True, False])
async def test_a_bar_on_a_terminal_and_nothing_but_lines_elsewhere(*, is_terminal: bool) -> None:
    file = io.StringIO()
    console = Console(file=file, force_terminal=is_terminal, width=120)
    snapshot = await last_snapshot()

    with ProgressBar(console) as bar:
        bar(snapshot)

    assert ("100%" in file.getvalue()) == is_terminal
    assert is_terminal or file.getvalue() == ""  # a run shorter than the time between two lines
