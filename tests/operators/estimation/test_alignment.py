"""Robots that do not know of each other, put together by their loops alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.estimation.batch import optimize_map
from mapstream.operators.estimation.outliers.alignment import AlignConfig, align_missions
from mapstream.recordings.g2o import read_g2o
from mapstream.recordings.kimera_multi import read_kimera_multi
from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Edges
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, invert, se3_exp, se3_log
from tests.data import shared
from tests.operators.estimation.problems import cov, wander, with_mission, with_relative

NUM = 40
COVARIANCE = cov(0.005, 0.05)
IDS = ("11" * 16, "22" * 16, "33" * 16)


def team(rng: np.random.Generator, *, true: int, false: int) -> tuple[Map, FloatArray]:
    """Three robots whose frames are unknown, each with loops to the next; return the map and all poses."""
    paths = [SE3.exp([0, 0, 0.7 * k, 3 * k, -2 * k, 0]).matrix @ wander(NUM, rng) for k in range(3)]
    truth = np.concatenate(paths)
    map_ = Map.empty()
    for name, path in zip(IDS, paths, strict=True):
        map_ = with_mission(invert(path[0]) @ path, map_, mission=name)
    map_ = replace(
        map_, missions=replace(map_.missions, T_map_mission=np.tile(paths[0][0], (3, 1, 1)))
    )
    links = [(k * NUM + i, k * NUM + i + 1) for k in range(3) for i in range(NUM - 1)]
    map_ = with_relative(map_, links, truth, COVARIANCE, rng=rng)
    for k in range(2):
        a, b = k * NUM + rng.integers(0, NUM, true), (k + 1) * NUM + rng.integers(0, NUM, true)
        map_ = with_relative(map_, zip(a, b, strict=True), truth, COVARIANCE, rng=rng, kind="loop")
        wrong = truth[rng.integers(0, 3 * NUM, false)]
        a, b = k * NUM + rng.integers(0, NUM, false), (k + 1) * NUM + rng.integers(0, NUM, false)
        edges = Edges(
            kind=np.full(false, "loop", dtype=object),
            vertex_a=a,
            vertex_b=b,
            T_a_b=se3_exp(rng.normal(0, [0.5] * 3 + [5.0] * 3, (false, 6))) @ wrong,
            covariance=np.tile(COVARIANCE, (false, 1, 1)),
            source=np.full(false, "false", dtype=object),
        )
        map_ = append_edges(map_, edges)
    is_loop = map_.edges.kind == "loop"
    return replace(map_, edges=replace(map_.edges, is_switchable=is_loop)), truth


@pytest.mark.parametrize("seed", range(3))
def test_missions_find_each_other_among_false_loops(seed: int) -> None:
    """80 % of the loops are false, and robots end where they were."""
    map_, truth = team(np.random.default_rng(seed), true=8, false=32)

    aligned, report = align_missions(map_)

    assert report.placed == list(IDS[1:])
    assert aligned.missions.is_base_frame_known.all()
    assert not report.left
    assert {(p.mission_a, p.mission_b) for p in report.pairs if p.is_used} == {
        (IDS[0], IDS[1]),
        (IDS[1], IDS[2]),
    }
    apart = se3_log(invert(truth[::NUM]) @ aligned.T_map_base(np.arange(0, 3 * NUM, NUM)))
    assert np.abs(apart[:, :3]).max() < 0.15
    assert np.abs(apart[:, 3:]).max() < 1.5

    result, _ = optimize_map(aligned)
    is_false = result.edges.source == "false"
    clean, _ = optimize_map(aligned.select(edges=~is_false))

    assert (result.edges.switch[is_false] == 0).all()
    rows = np.arange(3 * NUM)
    assert np.abs(result.T_map_base(rows) - clean.T_map_base(rows)).max() < 0.01


def test_a_mission_without_loops_enough_is_left_and_named() -> None:
    map_, _ = team(np.random.default_rng(0), true=8, false=0)
    last = map_.vertices.mission[map_.edges.vertex_b] == 2
    few = np.flatnonzero(last & (map_.edges.kind == "loop"))[2:]
    keep = np.ones(len(map_.edges), dtype=bool)
    keep[few] = False
    map_ = map_.select(edges=keep)

    aligned, report = align_missions(map_, AlignConfig(min_loops=3))

    assert report.left == [IDS[2]]
    assert aligned.missions.is_base_frame_known.tolist() == [True, True, False]
    np.testing.assert_array_equal(aligned.missions.T_map_mission[2], map_.missions.T_map_mission[2])


def test_missions_whose_place_is_known_stay() -> None:
    map_, _ = team(np.random.default_rng(1), true=8, false=8)
    known = np.array([False, True, False])
    map_ = replace(map_, missions=replace(map_.missions, is_base_frame_known=known))

    aligned, report = align_missions(map_)

    np.testing.assert_array_equal(aligned.missions.T_map_mission[1], map_.missions.T_map_mission[1])
    assert report.placed == [IDS[0], IDS[2]]


@pytest.mark.slow
def test_eight_robots_in_tunnels_do_not_collapse() -> None:
    """Turned as the reference is, the extent is within 5 % of 344 x 32 x 281 m."""
    map_ = read_kimera_multi(shared("kimera_multi_tunnels"))

    aligned, report = align_missions(map_)
    result, solved = optimize_map(aligned)

    assert not report.left
    assert len(report.pairs) == 28
    p = result.T_map_base(np.arange(len(result.vertices)))[:, :3, 3]
    turns = se3_exp(np.pad(np.random.default_rng(0).normal(0, 0.15, (3000, 3)), ((0, 0), (0, 3))))
    extents = np.ptp(p @ np.swapaxes(turns[:, :3, :3], 1, 2), axis=1)
    assert np.abs(extents / [344, 32, 281] - 1).max(axis=1).min() < 0.05
    dropped = len(solved.dropped) / solved.kinds["loop"].count
    assert 0.5 < dropped < 0.95


@pytest.mark.slow
def test_false_loops_between_simulated_robots_are_dropped() -> None:
    """The spoiled team ends where the clean one does."""
    folder = shared("multirobot_argos")
    files = [f"example_4robots/{k}.g2o" for k in range(4)]
    map_ = read_g2o(*(folder / "spoiled" / file for file in files), are_loops_switchable=True)

    aligned, report = align_missions(map_)
    result, solved = optimize_map(aligned)

    assert not report.left
    assert result.missions.is_base_frame_known.all()
    assert solved.dropped
