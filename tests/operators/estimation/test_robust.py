"""Loops that are false: found, switched off, and reported."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.estimation.outliers.consistency import cycle_chi2
from mapstream.operators.estimation.outliers.scores import read_labels, score_loops
from mapstream.recordings.g2o import read_g2o
from mapstream.recordings.maps.build import add_edges
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import RelativePose
from tests.data import shared
from tests.operators.estimation import worlds

NUM, LAP = 120, 60


def moved_5m(loop: RelativePose) -> RelativePose:
    return replace(loop, T_a_b=loop.T_a_b @ SE3.from_rotation(np.eye(3), [3.0, 4.0, 0.0]))


@pytest.mark.parametrize("seed", range(3))
def test_F7_a_true_loop_keeps_its_switch_and_a_false_one_of_5m_loses_it(seed: int) -> None:
    """True: 1 +- 1e-3. False: below 1e-3, and the trajectory is within 1 mm of that by true loops alone."""
    map_, truth, rng = worlds.drive(NUM, seed)
    true = worlds.loops(truth, rng, lap=LAP)
    false = moved_5m(true[4])
    without, _ = optimize_map(add_edges(map_, true))

    result, report = optimize_map(add_edges(map_, [*true, false]))

    switch, variance = result.edges.switch[NUM - 1 :], result.edges.switch_variance[NUM - 1 :]
    np.testing.assert_allclose(switch[:-1], 1, atol=1e-3)
    assert switch[-1] < 1e-3
    assert np.isfinite(variance).all()
    assert variance[-1] < variance[:-1].min()  # 5 m leave no doubt
    distance = np.abs(result.vertices.T_mission_base - without.vertices.T_mission_base).max()
    assert distance < 1e-3
    (dropped,) = report.dropped
    assert (dropped.stamp_a_ns, dropped.stamp_b_ns) == (false.stamp_a_ns, false.stamp_b_ns)
    assert dropped.chi2 > 1000
    assert any("1 switched off" in line for line in report.lines())


def test_F7_a_switch_that_was_set_by_hand_stays() -> None:
    map_, truth, rng = worlds.drive(NUM, 3)
    loops = [replace(each, is_switchable=False) for each in worlds.loops(truth, rng, lap=LAP)]
    map_ = add_edges(map_, [*loops, replace(moved_5m(loops[0]), is_switchable=False)])
    off = np.ones(len(map_.edges))
    off[-1] = 0
    edited = replace(map_, edges=replace(map_.edges, switch=off))

    result, _ = optimize_map(edited)

    assert result.edges.switch[-1] == 0
    assert worlds.rmse_m(result.vertices.T_mission_base, truth) < 0.3
    assert worlds.rmse_m(optimize_map(map_)[0].vertices.T_mission_base, truth) > 0.3


@pytest.mark.parametrize("seed", range(3))
def test_H19_a_third_of_false_loops_does_not_hurt(seed: int) -> None:
    """30 % false: the error is below 1.2 times that without them."""
    map_, truth, rng = worlds.drive(NUM, seed)
    true = worlds.loops(truth, rng, lap=LAP, every=2)
    ends = rng.choice(NUM, (13, 2))
    false = [worlds.false_loop(int(a), int(b), rng) for a, b in ends if a != b]
    clean, _ = optimize_map(add_edges(map_, true))

    result, _ = optimize_map(add_edges(map_, true + false))

    error = worlds.rmse_m(result.vertices.T_mission_base, truth)
    assert error < 1.2 * worlds.rmse_m(clean.vertices.T_mission_base, truth)
    is_false = np.arange(len(result.edges)) >= NUM - 1 + len(true)
    score = score_loops(result, is_false)
    assert (score.precision, score.recall) == (1, 1)
    assert score.num_false == len(false)


def test_a_cycle_with_odometry_is_within_its_covariance() -> None:
    """Chi2 of true loops follows its distribution; loops that go back in time count the same."""
    map_, truth, rng = worlds.drive(NUM, 5)
    true = worlds.loops(truth, rng, lap=LAP, every=1)
    back = [
        replace(
            loop, stamp_a_ns=loop.stamp_b_ns, stamp_b_ns=loop.stamp_a_ns, T_a_b=loop.T_a_b.inverse()
        )
        for loop in true
    ]
    map_ = add_edges(map_, true + back)

    chi2 = cycle_chi2(map_, np.arange(NUM - 1, len(map_.edges)))

    assert 1 < np.median(chi2[: len(true)]) < 12
    np.testing.assert_allclose(chi2[len(true) :], chi2[: len(true)], rtol=0.1)


@pytest.mark.parametrize("text", ["0 0\n2 1\n", "a b\n", "0\n1\n"])
def test_labels_that_are_none_are_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "false.labels"
    file.write_text(text)

    with pytest.raises(RecordingError, match=r"false\.labels: expected lines"):
        read_labels(file)


@pytest.mark.slow
@pytest.mark.parametrize("graph", ["intel_out500", "sphere2500_out1000"])
def test_false_loops_of_public_pose_graphs_are_dropped(graph: str) -> None:
    folder = shared("posegraphs")
    clean, _ = optimize_map(read_g2o(folder / f"{graph.split('_', 1)[0]}.g2o"))

    result, report = optimize_map(read_g2o(folder / f"{graph}.g2o", are_loops_switchable=True))

    rows = np.arange(len(clean.vertices))
    apart = (result.T_map_base(rows) - clean.T_map_base(rows))[:, :3, 3]
    assert np.sqrt((apart**2).sum(axis=1).mean()) < 0.05  # m
    score = score_loops(result, read_labels(folder / f"{graph}.g2o.labels"))
    assert (score.precision, score.recall) == (1, 1)
    assert len(report.dropped) == score.num_false


@pytest.mark.slow
def test_a_start_that_is_a_trap_is_left_by_the_chordal_one() -> None:
    """Levenberg-Marquardt from odometry ends at 385.12."""
    map_ = read_g2o(shared("posegraphs") / "MIT.g2o", are_loops_switchable=True)

    _, report = optimize_map(map_)
    _, trapped = optimize_map(map_, OptimizeConfig(start="current", is_robust=False))

    assert report.error_after == pytest.approx(20.60347, rel=1e-3)
    assert (report.start, report.switched_off) == ("chordal", [])
    assert trapped.error_after > 300
