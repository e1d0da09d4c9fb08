"""Loops that others found become edges between the nearest vertices, exact to their stamps."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.graph.load import parse_graph
from mapstream.graph.plan import plan
from mapstream.graph.run import run_graph
from mapstream.operators.operator import Context
from mapstream.operators.submaps.external_loops import ExternalLoops, ExternalLoopsConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps import load_map
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.constraints import LoopClosure
from mapstream.streams.messages.estimates import Keyframe, LoopReport, Odometry, Submap

pytestmark = pytest.mark.anyio

ONE, TWO = "1" * 32, "2" * 32
RATES = {ONE: [0, 0, 0.2, 1.0, 0.1, 0], TWO: [0.1, 0, -0.3, 0.5, 0, 0.2]}  # per second
STARTS = {ONE: SE3.identity(), TWO: SE3.exp([0.3, 0.1, -0.5, 4, 5, 6])}  # in the map
TIGHT = np.diag([1e-4] * 3 + [1e-2] * 3)
SECOND = 1_000_000_000


def odometry(mission: str, stamp_ns: int) -> SE3:
    """A steady turn and a steady way, so that interpolation between keyframes is exact."""
    turned, gone = np.split(np.array(RATES[mission]) * stamp_ns / SECOND, 2)
    return SE3.from_rotation(so3_exp(turned), gone)


def place(mission: str, stamp_ns: int) -> SE3:
    return STARTS[mission] @ odometry(mission, stamp_ns)


def submap(mission: str, index: int, *seconds: int) -> Submap:
    keyframes = [
        Keyframe(
            stamp_ns=s * SECOND,
            odometry=Odometry(stamp_ns=s * SECOND, T_odom_base=odometry(mission, s * SECOND)),
        )
        for s in seconds
    ]
    return Submap(mission_id=mission, index=index, keyframes=tuple(keyframes), edges=())


def loop(a: str, stamp_a_ns: int, b: str, stamp_b_ns: int, **options: object) -> LoopClosure:
    T_a_b = place(a, stamp_a_ns).inverse() @ place(b, stamp_b_ns)
    fields = {"covariance": TIGHT, "source": "radio", "robot_a": a, "robot_b": b} | options
    return LoopClosure(stamp_a_ns=stamp_a_ns, stamp_b_ns=stamp_b_ns, T_a_b=T_a_b, **fields)  # type: ignore[arg-type]  # made up


async def reports_of(
    loops: list[LoopClosure],
    submaps: list[Submap],
    config: ExternalLoopsConfig | None = None,
    reports: list[LoopReport] | None = None,
) -> tuple[list[LoopReport], Context]:
    found = Context()
    operator = ExternalLoops(config or ExternalLoopsConfig())
    inputs = {"loops": loops, "submaps": submaps} | (
        {} if reports is None else {"reports": reports}
    )
    sent = await run_operator(operator, run_context=found, **inputs)  # type: ignore[arg-type]  # ports by name
    return sent["loops"], found


@settings(max_examples=15, deadline=None)
@given(a_ns=st.integers(1, 10 * SECOND), b_ns=st.integers(1, 10 * SECOND))
async def test_A15_a_loop_becomes_one_edge_exact_to_its_stamps(a_ns: int, b_ns: int) -> None:
    """Wherever its instants lie, the edge is the true motion between the vertices nearest to them."""
    submaps = [submap(ONE, 0, 0, 2, 5, 10), submap(TWO, 0, 0, 3, 6, 10)]

    (first, second), _ = await reports_of([loop(ONE, a_ns, TWO, b_ns)], submaps)

    (edge,) = (*first.edges, *second.edges)
    assert abs(edge.stamp_a_ns - a_ns) == min(abs(s * SECOND - a_ns) for s in (0, 2, 5, 10))
    assert abs(edge.stamp_b_ns - b_ns) == min(abs(s * SECOND - b_ns) for s in (0, 3, 6, 10))
    expected = place(ONE, edge.stamp_a_ns).inverse() @ place(TWO, edge.stamp_b_ns)
    np.testing.assert_allclose(edge.T_a_b.matrix, expected.matrix, atol=1e-9)
    assert (edge.kind, edge.mission_a, edge.mission_b, edge.source) == ("loop", ONE, TWO, "radio")
    assert edge.is_switchable
    carried = odometry(TWO, b_ns).inverse() @ odometry(TWO, edge.stamp_b_ns)
    adjoint = carried.inverse().adjoint()
    np.testing.assert_allclose(edge.covariance, adjoint @ TIGHT @ adjoint.T, atol=1e-9)


async def test_A15_a_loop_waits_for_the_submaps_of_both_its_ends() -> None:
    submaps = [
        submap(ONE, 0, 0, 2),
        submap(ONE, 1, 2, 4),
        submap(TWO, 0, 0, 5),
        submap(ONE, 2, 4, 6),
    ]
    loops = [loop(ONE, SECOND, TWO, SECOND), loop(ONE, SECOND, ONE, 4 * SECOND)]

    reports, found = await reports_of(loops, submaps)

    assert [len(report.edges) for report in reports] == [0, 1, 1, 0]
    assert [report.stamp_ns for report in reports] == [s.stamp_ns for s in submaps]
    assert found.activity.losses == {}


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"quality": 0.2}, "its quality is 0.2, below 0.5"),
        ({"quality": float("nan")}, "its quality is nan, below 0.5"),
        ({"covariance": np.zeros((6, 6))}, "its covariance is not positive definite"),
        ({"covariance": np.full((6, 6), np.inf)}, "its covariance is not symmetric and finite"),
        ({"stamp_b_ns": 4 * SECOND + 1}, "both ends lie at one vertex"),
        (
            {"stamp_b_ns": 5},
            "5 ns lies outside mission 1{32}, which spans .*; it looks like seconds",
        ),
        ({"robot_b": ""}, "both ends lie at one vertex"),
    ],
)
async def test_U2_every_rejected_loop_says_why(options: dict[str, object], reason: str) -> None:
    stamp_b_ns = int(options.pop("stamp_b_ns", 4 * SECOND))  # type: ignore[call-overload]  # made up
    made = loop(ONE, 4 * SECOND, ONE, stamp_b_ns, **options)

    (report,), found = await reports_of(
        [made], [submap(ONE, 0, 4, 6, 8)], ExternalLoopsConfig(min_quality=0.5)
    )

    (candidate,) = report.candidates
    assert report.edges == ()
    assert re.match(reason, candidate.verdict), candidate.verdict
    assert list(found.activity.warnings) == [f"a loop was rejected: {candidate.verdict}"]


async def test_loops_that_never_find_a_place_are_counted_as_lost() -> None:
    loops = [loop(ONE, SECOND, TWO, SECOND), loop(ONE, SECOND, ONE, 99 * SECOND)]

    _, found = await reports_of(loops, [submap(ONE, 0, 0, 2), submap(ONE, 1, 2, 3)])

    assert set(found.activity.losses) == {
        f"a loop that found no place: no mission of robot {TWO!r} came; there are {[ONE]}",
        f"a loop that found no place: mission {ONE} ends before 99000000000 ns",
    }


async def test_robots_are_named_by_digits_or_by_the_config() -> None:
    """No digits are enough where there is one mission alone."""
    named = ExternalLoopsConfig(robots={"rover": TWO[:4]})
    two = [submap(ONE, 0, 0, 2), submap(TWO, 0, 0, 2)]
    made = loop(ONE, SECOND, TWO, SECOND, robot_a=ONE[:6], robot_b="rover")
    alone = loop(ONE, SECOND, ONE, 9 * SECOND, robot_a="husky", robot_b="husky")

    several, _ = await reports_of([made], two, named)
    only = ExternalLoopsConfig(robots={"husky": ""})
    one, _ = await reports_of([alone], [submap(ONE, 0, 0, 9)], only)

    assert [edge.mission_b for report in several for edge in report.edges] == [TWO]
    assert [len(report.edges) for report in one] == [1]


async def test_A15_C15_a_robot_whose_odometry_was_split_has_a_mission_for_each_stretch() -> None:
    """The stamp says which; between two missions there is none."""
    any_name = ExternalLoopsConfig(robots={"husky": ""})
    drive = [submap(ONE, 0, 0, 2), submap(ONE, 1, 2, 4), submap(TWO, 0, 6, 8), submap(TWO, 1, 8, 9)]
    names = {"robot_a": "husky", "robot_b": "husky"}
    across = loop(ONE, SECOND, TWO, 7 * SECOND, **names)
    inside = loop(TWO, 6 * SECOND, TWO, 9 * SECOND, **names)
    between = loop(ONE, SECOND, ONE, 5 * SECOND, **names)

    reports, _ = await reports_of([between, across, inside], drive, any_name)

    assert [[(e.mission_a, e.mission_b) for e in report.edges] for report in reports] == [
        [],
        [],
        [(ONE, TWO)],
        [(TWO, TWO)],
    ]
    (rejected,) = [c.verdict for r in reports for c in r.candidates if c.verdict != "accepted"]
    assert rejected == f"{5 * SECOND} ns lies in none of the missions of 'husky': {[ONE, TWO]}"


async def test_A15_missions_of_one_name_at_the_same_time_are_refused() -> None:
    made = loop(ONE, SECOND, TWO, 4 * SECOND, robot_a="husky", robot_b="husky")
    drive = [submap(ONE, 0, 0, 3), submap(TWO, 0, 2, 4)]

    reports, _ = await reports_of([made], drive, ExternalLoopsConfig(robots={"husky": ""}))

    (verdict,) = [c.verdict for report in reports for c in report.candidates]
    assert verdict.startswith("several missions are called 'husky' at the same time")


async def test_what_another_search_found_stays() -> None:
    submaps = [submap(ONE, 0, 0, 2)]
    edges = (await reports_of([loop(ONE, 0, ONE, 2 * SECOND)], submaps))[0][0].edges
    other = LoopReport(stamp_ns=2 * SECOND, edges=edges)

    (report,), _ = await reports_of([loop(ONE, 0, ONE, 2 * SECOND)], submaps, reports=[other])

    assert len(report.edges) == 2


GRAPH = """
version: 1
name: loops
params: {recording: {type: path}, map: {type: path}}
operators:
  sensors: {use: mcap, config: {path: $recording, topics: {odometry: /odometry, loops: /loops}}}
  keyframes: {use: keyframes, in: {odometry: sensors.odometry}}
  submaps: {use: submap_builder, in: {keyframes: keyframes.keyframes}, config: {num_keyframes: 4}}
  loops:
    use: external_loops
    in: {loops: sensors.loops, submaps: submaps.submaps}
    config: {robots: {husky: ""}}
  optimizer: {use: optimizer, in: {submaps: submaps.submaps, loops: loops.loops}, run: inline}
  store: {use: map_store, in: {maps: optimizer.maps}, config: {path: $map}, run: inline}
"""


SPLIT = GRAPH.replace(
    "in: {odometry: sensors.odometry}",
    "in: {odometry: guard.odometry}",
).replace(
    "  keyframes:",
    "  guard: {use: odometry_guard, in: {odometry: sensors.odometry}, config: {on_jump: split}}\n"
    "  keyframes:",
)


async def test_A15_C15_a_recorded_loop_joins_what_a_jump_has_split(tmp_path: Path) -> None:
    """The odometry begins again, 80 m away; a loop says where the robot really was."""
    with McapWriter(tmp_path / "drive.mcap") as writer:
        for i in range(20):
            way_m = 0.5 * i if i < 10 else 0.5 * i + 80
            pose = SE3.from_rotation(np.eye(3), [way_m, 0, 0])
            writer.write("/odometry", Odometry(stamp_ns=SECOND * (i + 1), T_odom_base=pose))
        beside = LoopClosure(
            robot_a="husky",
            stamp_a_ns=SECOND * 5,
            robot_b="husky",
            stamp_b_ns=SECOND * 15,
            T_a_b=SE3.from_rotation(np.eye(3), [5.0, 0, 0]),
            covariance=np.eye(6) * 1e-6,
        )
        writer.write("/loops", beside, log_ns=SECOND * 20 + 1)
    values = {"recording": str(tmp_path / "drive.mcap"), "map": str(tmp_path / "map")}

    report = await run_graph(plan(parse_graph(SPLIT, params=values)))

    assert report.status == "complete", report.reasons
    map_ = load_map(tmp_path / "map")
    assert (len(map_.missions), len(map_.edges_of("loop"))) == (2, 1)
    seconds = map_.vertices.stamp_ns / SECOND
    places = map_.T_map_base(np.arange(len(seconds)))[:, :3, 3]
    np.testing.assert_allclose(places[:, 0], 0.5 * (seconds - 1), atol=0.01)


async def test_A15_a_recorded_loop_closes_a_drive_in_a_graph(tmp_path: Path) -> None:
    """A robot goes 5 m and comes back, but its odometry says that it is 0.1 m short."""
    ways_m = [*np.arange(0, 5, 0.5), *np.linspace(5, 0.1, 11)]
    with McapWriter(tmp_path / "drive.mcap") as writer:
        for i, way_m in enumerate(ways_m):
            pose = SE3.from_rotation(np.eye(3), [way_m, 0, 0])
            writer.write("/odometry", Odometry(stamp_ns=SECOND * (i + 1), T_odom_base=pose))
        back = LoopClosure(
            robot_a="husky",
            stamp_a_ns=SECOND,
            robot_b="husky",
            stamp_b_ns=SECOND * len(ways_m),
            T_a_b=SE3.identity(),
            covariance=np.eye(6) * 1e-6,
        )
        writer.write("/loops", back, log_ns=SECOND * len(ways_m) + 1)
    values = {"recording": str(tmp_path / "drive.mcap"), "map": str(tmp_path / "map")}

    report = await run_graph(plan(parse_graph(GRAPH, params=values)))

    assert report.status == "complete", report.reasons
    map_ = load_map(tmp_path / "map")
    (row,) = map_.edges_of("loop")
    assert map_.vertices.stamp_ns[
        [map_.edges.vertex_a[row], map_.edges.vertex_b[row]]
    ].tolist() == [
        SECOND,
        SECOND * len(ways_m),
    ]
    last = map_.vertices.T_mission_base[map_.edges.vertex_b[row]]
    np.testing.assert_allclose(last[:3, 3], [0, 0, 0], atol=0.01)
