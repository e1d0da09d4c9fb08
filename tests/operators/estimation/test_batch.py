from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.estimation.batch import optimize_map
from mapstream.recordings.g2o import read_g2o
from mapstream.recordings.maps.build import add_edges
from mapstream.recordings.maps.check import check_map
from tests.data import shared
from tests.operators.estimation import worlds

NUM, LAP = 120, 60


def test_K1_a_loop_moves_the_past() -> None:
    map_, truth, rng = worlds.drive(NUM, 1)
    before = worlds.rmse_m(map_.vertices.T_mission_base, truth)

    closed, report = optimize_map(add_edges(map_, worlds.loops(truth, rng, lap=LAP)))

    assert worlds.rmse_m(closed.vertices.T_mission_base, truth) < 0.6 * before
    assert report.error_after < report.error_before
    assert report.num_edges == {"loop": 12, "odometry": NUM - 1}
    assert not check_map(closed)


@pytest.mark.parametrize("seed", range(5))
def test_false_loops_are_switched_off_and_true_ones_kept(seed: int) -> None:
    map_, truth, rng = worlds.drive(NUM, seed)
    true = worlds.loops(truth, rng, lap=LAP)
    clean, _ = optimize_map(add_edges(map_, true))
    ends = rng.permutation(NUM)
    false = [worlds.false_loop(int(ends[2 * k]), int(ends[2 * k + 1]), rng) for k in range(6)]

    result, report = optimize_map(add_edges(map_, true + false))

    first_false = NUM - 1 + len(true)
    assert report.switched_off == list(range(first_false, first_false + len(false)))
    assert result.edges.switch[NUM - 1 : first_false].min() > 0.5
    distance = np.abs(result.vertices.T_mission_base - clean.vertices.T_mission_base).max()
    assert distance < 0.02


def test_the_first_vertex_stays() -> None:
    map_, truth, rng = worlds.drive(NUM, 2)

    closed, _ = optimize_map(add_edges(map_, worlds.loops(truth, rng, lap=LAP)))

    np.testing.assert_allclose(
        closed.vertices.T_mission_base[0], map_.vertices.T_mission_base[0], atol=1e-9
    )


def test_edges_of_unknown_kinds_are_counted_and_kept() -> None:
    map_, truth, rng = worlds.drive(NUM, 3)
    kinds = map_.edges.kind.copy()
    kinds[3] = "sonar"
    odd = add_edges(
        replace(map_, edges=replace(map_.edges, kind=kinds)), worlds.loops(truth, rng, lap=LAP)
    )
    result, report = optimize_map(odd)

    assert report.ignored == {"sonar": 1}
    assert result.edges.kind[3] == "sonar"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("graph", "expected"),
    [
        ("tinyGrid3D", 9.313904),
        ("smallGrid3D", 517.9253),
        ("parking-garage", 0.634192),
        ("CSAIL", 20.27544),
        ("intel", 22.50212),
        ("sphere2500", 675.7010),
    ],
)
def test_optimum_of_public_pose_graphs(graph: str, expected: float) -> None:
    """Within 0.1 %, with every loop kept, though each might be false."""
    map_ = read_g2o(shared("posegraphs") / f"{graph}.g2o", are_loops_switchable=True)

    result, report = optimize_map(map_)

    assert report.error_after == pytest.approx(expected, rel=1e-3)
    assert (result.edges.switch == 1).all()
