"""Running plans: every message arrives, in order, whatever the placement; errors end a run orderly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import anyio
import pytest
from anyio.lowlevel import checkpoint

from mapstream.graph.metrics import Snapshot
from mapstream.graph.plan import Edge, Plan
from mapstream.graph.run import policy_of, run_graph
from mapstream.graph.spec import PROFILES, OnErrorSpec
from mapstream.operators.operator import Placement
from mapstream.streams.channel import Arrival, Limits
from tests.graph.made_plans import chain, make_plan, node
from tests.graph.operators_for_tests import (
    COLLECTED,
    GATES,
    Block,
    Collect,
    Digest,
    Head,
    ManySteps,
    Source,
    Step,
    Sum,
    Zip,
)

pytestmark = pytest.mark.anyio


def values(name: str = "sink") -> list[int]:
    return [block.value for block in COLLECTED[name]]


async def test_every_message_arrives_in_order() -> None:
    report = await run_graph(
        chain(source=node(Source, count=100), step=node(Step), sink=node(Collect))
    )

    assert report.status == "complete"
    assert report.exit_code == 0
    assert values() == [2 * i for i in range(100)]


async def test_a_fork_gives_each_branch_everything() -> None:
    plan = make_plan(
        {"source": node(Source), "left": node(Collect), "right": node(Collect)},
        "source.blocks -> left.blocks",
        "source.blocks -> right.blocks",
    )

    await run_graph(plan)

    assert values("left") == values("right") == list(range(10))


async def test_an_optional_input_without_an_edge_is_none() -> None:
    plan = make_plan(
        {"source": node(Source), "zip": node(Zip), "sink": node(Collect)},
        "source.blocks -> zip.a",
        "zip.blocks -> sink.blocks",
    )

    await run_graph(plan)

    assert values() == list(range(10))


@pytest.mark.parametrize("workers", [1, 2, 4])
async def test_B14_workers_change_nothing(workers: int, tmp_path: Path) -> None:
    def plan(path: Path, placement: Placement, workers: int) -> Plan:
        return chain(
            source=node(Source, count=60, size=100),
            steps=node(ManySteps, placement, workers),
            sink=node(Digest, path=path),
        )

    await run_graph(plan(tmp_path / "inline", "inline", 1))
    await run_graph(plan(tmp_path / "thread", "thread", workers))

    assert (tmp_path / "thread").read_text() == (tmp_path / "inline").read_text()
    assert (tmp_path / "inline").read_text().startswith("60 ")


async def test_a_new_epoch_makes_a_new_operator_and_is_marked_downstream() -> None:
    report = await run_graph(
        chain(
            source=node(Source, count=4, epochs=3),
            first=node(Sum),
            second=node(Sum),
            sink=node(Collect),
        )
    )

    assert report.status == "complete"
    assert values() == [0, 1, 4, 10] * 3


async def test_an_operator_that_returns_early_leaves_the_rest_running() -> None:
    plan = make_plan(
        {"source": node(Source, count=50), "head": node(Head, count=2), "sink": node(Collect)},
        "source.blocks -> head.blocks",
        "source.blocks -> sink.blocks",
    )

    report = await run_graph(plan)

    assert report.status == "complete"  # what nobody wanted is no loss
    assert values() == list(range(50))


async def test_a_source_whose_readers_have_all_returned_is_stopped() -> None:
    report = await run_graph(chain(source=node(Source, is_endless=True), head=node(Head)))

    assert report.status == "complete"


async def test_an_error_names_operator_stamp_and_cause_and_lets_the_others_finish() -> None:
    report = await run_graph(
        chain(source=node(Source, count=50), step=node(Step, fail_at=4), sink=node(Collect))
    )

    assert report.status == "failed"
    assert report.exit_code == 1
    (error,) = report.errors
    assert "'step' (Step)" in str(error)
    assert "blocks at stamp_ns 4000000" in str(error)
    assert "ValueError: no 4 please" in str(error)
    assert isinstance(error.__cause__, ValueError)
    assert values() == [0, 2, 4, 6]


async def test_an_error_in_a_thread_of_a_pipeline_is_told_plainly() -> None:
    report = await run_graph(
        chain(
            source=node(Source),
            steps=node(ManySteps, "thread", 2, fail_at=5),
            sink=node(Collect),
        )
    )

    assert "ValueError: no 5 please" in report.reasons[0]


async def test_skip_goes_on_with_the_next_message() -> None:
    step = node(Step, fail_at=4, on_error=OnErrorSpec(do="skip"))

    report = await run_graph(chain(source=node(Source), step=step, sink=node(Collect)))

    assert report.status == "lossy"
    assert report.exit_code == 3
    assert values() == [2 * i for i in range(10) if i != 4]


async def test_restart_makes_a_new_operator() -> None:
    adder = node(Sum, fail_at=3, on_error=OnErrorSpec(do="restart", backoff_s=0))

    report = await run_graph(chain(source=node(Source, count=6), sum=adder, sink=node(Collect)))

    assert report.status == "lossy"
    assert values() == [0, 1, 3, 4, 9]  # after the error the sum begins anew with 4


async def test_too_many_errors_stop_the_run() -> None:
    """Every block fails; the second error is one too many."""
    plan = chain(
        source=node(Source),
        zeros=node(Step, factor=0),
        step=node(Step, fail_at=0, on_error=OnErrorSpec(do="skip", max=1)),
        sink=node(Collect),
    )

    report = await run_graph(plan)

    assert report.status == "failed"
    assert len(report.errors) == 2


def test_a_live_source_restarts_by_default_and_all_else_stops_the_run() -> None:
    plan = chain(source=node(Source), sink=node(Collect))
    live = replace(plan, profile=PROFILES["live"])

    assert policy_of(live.nodes["source"], live).do == "restart"
    assert policy_of(live.nodes["sink"], live).do == "stop"
    assert policy_of(plan.nodes["source"], plan).do == "stop"


async def test_disable_ends_one_operator_alone() -> None:
    plan = make_plan(
        {
            "source": node(Source, count=50),
            "step": node(Step, fail_at=3, on_error=OnErrorSpec(do="disable")),
            "steps": node(Collect),
            "sink": node(Collect),
        },
        "source.blocks -> step.blocks",
        "step.blocks -> steps.blocks",
        "source.blocks -> sink.blocks",
    )

    report = await run_graph(plan)

    assert report.status == "lossy"
    assert values("steps") == [0, 2, 4]
    assert values("sink") == list(range(50))


async def test_B11_drops_are_counted_by_edge_and_make_the_run_lossy() -> None:
    GATES["open"] = anyio.Event()
    plan = make_plan(
        {
            "source": node(Source, count=100),
            "slow": node(Step, gate="open"),
            "slow_sink": node(Collect),
            "sink": node(Collect),
        },
        "source.blocks -> slow.blocks",
        "slow.blocks -> slow_sink.blocks",
        "source.blocks -> sink.blocks",
        limits_of={"source.blocks -> slow.blocks": Limits(policy="drop_oldest", capacity=4)},
    )

    def open_at_the_end(edge: Edge, message: Block, arrival: Arrival) -> None:
        if edge.to_node == "sink" and message.value == 99:
            GATES["open"].set()

    report = await run_graph(plan, taps=[open_at_the_end])

    dropped = 100 - len(values("slow_sink"))
    assert report.status == "lossy"
    assert report.reasons == (
        f"source.blocks -> slow.blocks: {dropped} messages dropped ({dropped} full)",
    )
    assert values("sink") == list(range(100))  # a slow reader takes nothing from a fast one


async def test_B1_a_slow_operator_does_not_delay_a_fast_one() -> None:
    """While one branch stands still for good, the other gets every message."""
    GATES["open"] = anyio.Event()
    plan = make_plan(
        {
            "source": node(Source, count=100),
            "slow": node(Step, "thread", gate="open"),
            "slow_sink": node(Collect),
            "fast": node(Step, "thread"),
            "sink": node(Collect),
        },
        "source.blocks -> slow.blocks",
        "slow.blocks -> slow_sink.blocks",
        "source.blocks -> fast.blocks",
        "fast.blocks -> sink.blocks",
        limits_of={"source.blocks -> slow.blocks": Limits(policy="latest")},
    )
    seen_while_slow = []

    def look(edge: Edge, message: Block, arrival: Arrival) -> None:
        if edge.to_node == "sink":
            seen_while_slow.append(message.value)
            if len(seen_while_slow) == 100:
                GATES["open"].set()

    await run_graph(plan, taps=[look])

    assert seen_while_slow == [2 * i for i in range(100)]
    assert values("slow_sink")[-1] == 198  # the latest, once it moved again


async def test_a_tap_sees_each_message_with_its_arrival() -> None:
    seen: list[tuple[str, int, int, int]] = []

    def tap(edge: Edge, message: Block, arrival: Arrival) -> None:
        seen.append((edge.to_node, message.value, arrival.sequence, arrival.epoch))

    await run_graph(chain(source=node(Source, count=2, epochs=2), sink=node(Collect)), taps=[tap])

    assert seen == [("sink", 0, 0, 0), ("sink", 1, 1, 0), ("sink", 0, 2, 1), ("sink", 1, 3, 1)]


async def test_a_tap_that_raises_is_taken_out_and_named() -> None:
    def tap(edge: Edge, message: Block, arrival: Arrival) -> None:
        raise RuntimeError("no screen")

    report = await run_graph(chain(source=node(Source), sink=node(Collect)), taps=[tap])

    assert report.status == "complete"
    assert values() == list(range(10))
    assert "no screen" in report.warnings[0]


async def test_R4_P7_the_last_snapshot_has_times_rates_and_depths() -> None:
    snapshots: list[Snapshot] = []

    report = await run_graph(
        chain(source=node(Source, count=50), step=node(Step, "thread"), sink=node(Collect)),
        on_progress=snapshots.append,
    )

    final = snapshots[-1]
    assert final == report.final
    source, step, sink = final.operators
    assert step.num_calls == 50
    assert 0 < step.p50_s <= step.p95_s <= step.p99_s <= final.wall_s
    assert 0 < step.cpu_s <= step.busy_s + source.busy_s + sink.busy_s
    assert [(e.sent, e.received, e.depth) for e in final.edges] == [(50, 50, 0)] * 2
    assert 1 <= final.edges[0].high_water <= 8
    assert final.position_ns == 49_000_000
    assert final.limiting in ("source", "step")
    assert final.to_json()["operators"][0]["p50_s"] is None  # no calls, and JSON knows no nan


async def test_an_unknown_type_is_checked_at_the_first_message() -> None:
    plan = chain(source=node(Source), sink=node(Collect))
    (edge,) = plan.edges
    wrong = Edge(
        **{field: getattr(edge, field) for field in Edge.__slots__}
        | {"message_type": Limits, "is_unchecked": True}
    )

    report = await run_graph(Plan(name="wrong", nodes=plan.nodes, edges=(wrong,)))

    assert report.status == "failed"
    assert "source.blocks -> sink.blocks: expected Limits, got Block" in report.reasons[0]


async def test_cancelling_the_run_leaves_nothing_behind() -> None:
    GATES["open"] = anyio.Event()
    plan = chain(source=node(Source), step=node(Step, gate="open"), sink=node(Collect))

    with anyio.CancelScope() as scope:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(run_graph, plan)
            await anyio.wait_all_tasks_blocked()
            scope.cancel()

    await checkpoint()
    assert scope.cancelled_caught
