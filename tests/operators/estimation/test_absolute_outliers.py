"""Fixes that contradict the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.estimation.outliers.absolute_outliers import reject_absolute
from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Edges
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.geometry import SE3
from tests.operators.estimation.problems import (
    cov,
    position_errors_m,
    wander,
    with_mission,
    with_relative,
)

NUM = 200
FIX_SIGMA_M = 0.1


def with_fixes(
    map_: Map, truth: FloatArray, rng: np.random.Generator, *, share: float, least_m: float
) -> tuple[Map, BoolArray]:
    """Return the map with a position at every vertex, some shifted at random by at least so much."""
    num = len(truth)
    is_false = np.zeros(num, dtype=bool)
    is_false[rng.choice(num, round(share * num), replace=False)] = True
    p = truth[:, :3, 3] + rng.normal(0, FIX_SIGMA_M, (num, 3))
    away = rng.normal(size=(num, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    p[is_false] += (away * rng.uniform(least_m, 10, (num, 1)))[is_false]
    T = np.tile(np.eye(4), (num, 1, 1))
    T[:, :3, 3] = p
    covariance = np.diag([np.inf] * 3 + [FIX_SIGMA_M**2] * 3)
    edges = Edges(
        kind=np.full(num, "position", dtype=object),
        vertex_a=np.arange(num),
        T_a_b=T,
        covariance=np.tile(covariance, (num, 1, 1)),
    )
    return append_edges(map_, edges), is_false


def driven(seed: int, num: int = NUM) -> tuple[Map, FloatArray, np.random.Generator]:
    """A mission whose odometry has drifted, and whose frame lies elsewhere."""
    rng = np.random.default_rng(seed)
    truth, pairs = wander(num, rng), [(k, k + 1) for k in range(num - 1)]
    exact = with_relative(with_mission(truth), pairs, truth, cov(0.001, 0.01), rng=rng)
    poses = [truth[0]]
    for step in exact.edges.T_a_b:
        poses.append(poses[-1] @ step)
    elsewhere = SE3.exp([0.1, 0.0, 1.0, 5, -3, 1]).matrix
    vertices = replace(exact.vertices, T_mission_base=elsewhere @ np.array(poses))
    return replace(exact, vertices=vertices), truth, rng


@pytest.mark.parametrize("seed", range(3))
def test_K9_a_third_of_the_fixes_is_false_and_goes(seed: int) -> None:
    """All of 30 % that are 2 m off or more are removed, and 95 % of the others kept."""
    map_, truth, rng = driven(seed)
    map_, is_false = with_fixes(map_, truth, rng, share=0.3, least_m=2.0)

    result, report = reject_absolute(map_)

    switch = result.edges.switch[-NUM:]
    assert (switch[is_false] == 0).all()
    assert (switch[~is_false] == 1).mean() >= 0.95
    assert report.num_fixes == NUM
    assert report.rejected == (len(map_.edges) - NUM + np.flatnonzero(switch == 0)).tolist()


def test_K9_a_map_without_false_fixes_keeps_them() -> None:
    map_, truth, rng = driven(7)
    map_, _ = with_fixes(map_, truth, rng, share=0, least_m=2.0)

    result, _ = reject_absolute(map_)

    assert result.edges.switch.mean() >= 0.95


def test_K9_fewer_than_three_are_not_touched() -> None:
    map_, truth, rng = driven(1, num=20)
    map_, _ = with_fixes(map_, truth, rng, share=0.5, least_m=5.0)
    map_ = map_.select(edges=np.arange(len(map_.edges)) < 21)

    result, report = reject_absolute(map_)

    np.testing.assert_array_equal(result.edges.switch, 1)
    assert (report.num_fixes, report.num_untouched, report.rejected) == (2, 2, [])


def test_K9_an_optimisation_drops_them_first_and_says_so() -> None:
    """With 30 % false fixes the error is that of the fixes' own noise."""
    map_, truth, rng = driven(4)
    map_, _ = with_fixes(map_, truth, rng, share=0.3, least_m=2.0)

    spoiled, _ = optimize_map(map_)
    result, report = optimize_map(map_, OptimizeConfig(reject_absolute=True))

    assert np.sqrt((position_errors_m(result, truth) ** 2).mean()) < 0.1
    assert np.sqrt((position_errors_m(spoiled, truth) ** 2).mean()) > 0.3
    assert len(report.rejected_absolute) >= 0.3 * NUM
    assert any("contradict the others" in line for line in report.lines())
