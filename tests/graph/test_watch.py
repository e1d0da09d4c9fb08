"""Blocking channels neither deadlock where more room helps, nor hang where nothing does."""

from __future__ import annotations

import pytest

from mapstream.graph.run import run_graph
from mapstream.streams.channel import Limits
from tests.graph.made_plans import make_plan, node
from tests.graph.operators_for_tests import (
    COLLECTED,
    Collect,
    Feedback,
    Last,
    Source,
    Step,
    Waiting,
    Zip,
)

pytestmark = pytest.mark.anyio


@pytest.mark.parametrize("capacity", [1, 2, 8])
async def test_a_channel_grows_where_its_reader_waits_for_another_branch(capacity: int) -> None:
    """`zip` waits for `last`, which sends only when the source has ended: the other branch must hold all."""
    plan = make_plan(
        {
            "source": node(Source, count=50),
            "last": node(Last),
            "zip": node(Zip),
            "sink": node(Collect),
        },
        "source.blocks -> last.blocks",
        "source.blocks -> zip.a",
        "last.blocks -> zip.b",
        "zip.blocks -> sink.blocks",
        limits=Limits(capacity=capacity),
    )

    report = await run_graph(plan)

    assert report.status == "complete"
    assert [b.value for b in COLLECTED["sink"]] == [2 * i for i in range(50)]
    grown = {edge.name: edge.grown for edge in report.final.edges if edge.grown}
    assert list(grown) == ["source.blocks -> zip.a"]
    assert report.final.edges[1].capacity < 2 * 50


async def test_branches_of_equal_pace_do_not_grow() -> None:
    plan = make_plan(
        {
            "source": node(Source, count=50),
            "step": node(Step),
            "zip": node(Zip),
            "sink": node(Collect),
        },
        "source.blocks -> step.blocks",
        "source.blocks -> zip.a",
        "step.blocks -> zip.b",
        "zip.blocks -> sink.blocks",
        limits=Limits(capacity=1),
    )

    report = await run_graph(plan)

    assert [b.value for b in COLLECTED["sink"]] == [3 * i for i in range(50)]
    assert sum(edge.grown for edge in report.final.edges) == 0


async def test_a_feedback_cycle_runs() -> None:
    plan = make_plan(
        {
            "source": node(Source, count=5),
            "loops": node(Feedback),
            "step": node(Step),
            "sink": node(Collect),
        },
        "source.blocks -> loops.a",
        "loops.blocks -> step.blocks",
        "feedback step.blocks -> loops.b",
        "step.blocks -> sink.blocks",
        limits=Limits(capacity=1),
    )

    report = await run_graph(plan)

    assert report.status == "complete"
    assert [b.value for b in COLLECTED["sink"]] == [0, 2, 8, 22, 52]


async def test_a_deadlock_is_reported_with_its_cycle_and_the_rest_finishes() -> None:
    plan = make_plan(
        {
            "source": node(Source, count=50),
            "stuck": node(Waiting),
            "step": node(Step),
            "kept": node(Collect),
        },
        "source.blocks -> stuck.a",
        "stuck.blocks -> step.blocks",
        "feedback step.blocks -> stuck.b",
        "source.blocks -> kept.blocks",
    )

    report = await run_graph(plan)

    assert report.status == "failed"
    assert "step waits for a message of stuck.blocks -> step.blocks" in report.reasons[0]
    assert "stuck waits for a message of step.blocks -> stuck.b" in report.reasons[0]
    assert len(COLLECTED["kept"]) >= 8
