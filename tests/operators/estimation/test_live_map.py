from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.backend.live_map import LiveMap
from mapstream.operators.backend.optimizer import Optimizer, OptimizerConfig
from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.estimation.states import initial_values, poses_from
from mapstream.operators.maps.quality import map_quality
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import LoopReport
from tests.operators.estimation import worlds

NUM, LAP = 121, 60


def run_live(seed: int, num_false: int = 0) -> tuple[LiveMap, list[SE3]]:
    rng = np.random.default_rng(seed)
    truth = worlds.circle(NUM)
    loops = worlds.loops(truth, rng, lap=LAP)
    wrong = np.random.default_rng(seed + 1000)  # of its own: the drive is the same without them
    ends = wrong.permutation(LAP)
    loops += [worlds.false_loop(int(a), int(a) + LAP, wrong) for a in ends[:num_false]]
    live = LiveMap(OptimizeConfig())
    for submap in worlds.submaps(truth, rng):
        live.append(submap)
        stamps = {keyframe.stamp_ns for keyframe in submap.keyframes[1:]}
        live.close_loops([loop for loop in loops if loop.stamp_b_ns in stamps])
    return live, truth


def test_K2_incremental_equals_batch_after_convergence() -> None:
    live, _ = run_live(1)

    batch, _ = optimize_map(live.map, OptimizeConfig(is_robust=False))

    np.testing.assert_allclose(
        live.map.vertices.T_mission_base, batch.vertices.T_mission_base, atol=1e-4
    )


@pytest.mark.parametrize("seed", range(3))
def test_false_loops_leave_the_live_problem(seed: int) -> None:
    live, truth = run_live(seed, num_false=4)
    clean, _ = run_live(seed)

    assert live.num_contradictions > 0
    assert worlds.rmse_m(live.map.vertices.T_mission_base, truth) < 1.2 * worlds.rmse_m(
        clean.map.vertices.T_mission_base, truth
    )


def test_K2_a_removed_factor_leaves_the_problem_as_it_was() -> None:
    rng = np.random.default_rng(3)
    truth = worlds.circle(30, laps=1)
    live = LiveMap(OptimizeConfig())
    for submap in worlds.submaps(truth, rng):
        live.append(submap)
    before = live.map.vertices.T_mission_base
    live.close_loops([replace(worlds.false_loop(2, 25, rng), is_switchable=False)])
    moved = np.abs(live.map.vertices.T_mission_base - before).max()

    last = live.map.edges.id[-1].tobytes()
    live._problem.update(initial_values(live.map, []), {}, [last])
    live._problem.settle()

    assert moved > 0.1
    np.testing.assert_allclose(poses_from(live._problem.values(), len(before)), before, atol=1e-4)


def test_a_long_open_chain_survives_what_isam2_does_not() -> None:
    """A rebuild leaves the same poses: a chain without loops keeps its odometry."""
    truth = worlds.circle(50)
    live = LiveMap(OptimizeConfig())
    for submap in worlds.submaps(truth, np.random.default_rng(5)):
        live.append(submap)
    problem = live._problem
    before = poses_from(problem.values(), 50)

    problem._rebuild(initial_values(live.map, []))

    assert problem.num_rebuilds == 1
    np.testing.assert_allclose(poses_from(problem.values(), 50), before, atol=1e-6)


@pytest.mark.anyio
async def test_O1_every_submap_gives_a_correction_and_the_end_a_map() -> None:
    rng = np.random.default_rng(1)
    truth = worlds.circle(NUM)
    drive = worlds.submaps(truth, rng)
    loops = worlds.loops(truth, rng, lap=LAP)
    reports = [
        LoopReport(
            stamp_ns=s.stamp_ns,
            edges=tuple(e for e in loops if e.stamp_b_ns in {k.stamp_ns for k in s.keyframes[1:]}),
        )
        for s in drive
    ]

    sent = await run_operator(
        Optimizer(OptimizerConfig(map_every_submaps=4)), submaps=drive, loops=reports
    )

    assert [c.stamp_ns for c in sent["corrections"]] == [s.stamp_ns for s in drive]
    assert len(sent["maps"]) == len(drive) // 4 + 1
    final = sent["maps"][-1]
    assert worlds.rmse_m(final.vertices.T_mission_base, truth) < 0.2
    last = sent["corrections"][-1]
    newest = last.T_mission_odom @ drive[-1].keyframes[-1].odometry.T_odom_base
    np.testing.assert_allclose(newest.matrix, last.T_mission_base[-1], atol=1e-9)


@pytest.mark.anyio
async def test_G8_the_map_begins_at_the_initial_pose() -> None:
    drive = worlds.submaps(worlds.circle(21), np.random.default_rng(0))
    turned = OptimizerConfig(initial_position_m=(5, 6, 7), initial_quat_xyzw=(0, 0, 1, 1))

    plain = (await run_operator(Optimizer(OptimizerConfig()), submaps=drive))["maps"][-1]
    moved = (await run_operator(Optimizer(turned), submaps=drive))["maps"][-1]

    T_map_first = SE3.from_quat_xyzw((0, 0, 1, 1), (5, 6, 7)).matrix
    rows = np.arange(len(plain.vertices))
    np.testing.assert_allclose(
        moved.T_map_base(rows), T_map_first @ plain.T_map_base(rows), atol=1e-6
    )
    np.testing.assert_allclose(
        moved.vertices.T_mission_base, plain.vertices.T_mission_base, atol=1e-6
    )


def test_G8_a_new_mission_begins_without_the_symbols_of_the_last() -> None:
    """After a reset of time, poses of the same stamps are other poses, and the old ones stay."""
    first = worlds.submaps(worlds.circle(21), np.random.default_rng(0))
    live = LiveMap(OptimizeConfig())
    for submap in first:
        live.append(submap)
    before = live.map.vertices.T_mission_base.copy()

    other = "fedcba9876543210" * 2
    for submap in first:
        edges = tuple(replace(e, mission_a=other, mission_b=other) for e in submap.edges)
        live.append(replace(submap, mission_id=other, edges=edges))

    assert len(live.map.vertices) == 2 * len(before)
    assert live.map.missions.is_base_frame_known.tolist() == [True, False]
    np.testing.assert_allclose(live.map.vertices.T_mission_base[: len(before)], before, atol=1e-9)


@pytest.mark.anyio
async def test_K2_a_last_batch_that_bends_the_map_does_not_count() -> None:
    """Its time is over before the first iteration, so that it ends where it began."""
    rng = np.random.default_rng(1)
    truth = worlds.circle(NUM)
    loops = worlds.loops(truth, rng, lap=LAP)
    drive = worlds.submaps(truth, rng)
    reports = [LoopReport(stamp_ns=s.stamp_ns, edges=()) for s in drive]
    reports[-1] = replace(reports[-1], edges=tuple(loops))
    late = OptimizeConfig(start="chordal", max_seconds=1e-9, is_robust=False)
    found = Context()

    sent = await run_operator(
        Optimizer(OptimizerConfig(batch=late)), run_context=found, submaps=drive, loops=reports
    )

    final = sent["maps"][-1]
    bent, _ = optimize_map(final, late)
    assert map_quality(bent).worst > 1.25 > 2 * map_quality(final).worst
    assert worlds.rmse_m(final.vertices.T_mission_base, truth) < 0.2
    assert any("did not count: the map got worse" in each for each in found.activity.warnings)
