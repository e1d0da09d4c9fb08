"""Pose graphs are relaxed, and solutions that make a map worse are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.maps.edit import Disturbance, disturb
from mapstream.operators.maps.merge import merge
from mapstream.operators.maps.outliers import reject_loops
from mapstream.operators.maps.quality import map_quality, require_no_worse
from mapstream.operators.maps.relax import relax_map, relax_missions
from mapstream.operators.maps.residuals import chi2, relative_edges
from mapstream.operators.maps.stationary import StationaryConfig, fix_stationary
from mapstream.recordings.maps import Map, check_map
from mapstream.recordings.maps.build import add_edges
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, se3_exp
from tests.operators.estimation import worlds
from tests.recordings.made_maps import MISSION, OTHER_MISSION, full_map, line_map

LAP = 40


def drive(seed: int = 0) -> tuple[Map, list[SE3]]:
    """Two laps with noisy odometry, and where they truly led."""
    truth = worlds.circle(2 * LAP + 1)
    map_ = Map.empty()
    for submap in worlds.submaps(truth, np.random.default_rng(seed)):
        map_ = append_submap(map_, submap)
    return map_, truth


def test_K5_all_missions_are_relaxed_together() -> None:
    map_, truth = drive()
    looped = add_edges(map_, worlds.loops(truth, np.random.default_rng(1), lap=LAP))

    relaxed, report = relax_map(disturb(looped, Disturbance()))

    assert report.solved[0].num_edges == {"loop": 9, "odometry": 80}
    before = worlds.rmse_m(map_.vertices.T_mission_base, truth)
    assert worlds.rmse_m(relaxed.vertices.T_mission_base, truth) < 0.7 * before
    assert check_map(relaxed) == []


def test_K5_each_mission_is_relaxed_for_itself() -> None:
    both, _ = merge([full_map(), line_map(4, OTHER_MISSION)])
    noisy = disturb(both, Disturbance(seed=1))

    relaxed, report = relax_missions(noisy, [1])

    assert len(report.solved) == 1
    rows = relative_edges(noisy)
    is_second = noisy.vertices.mission[noisy.edges.vertex_a[rows]] == 1
    np.testing.assert_allclose(chi2(relaxed, rows)[is_second], 0, atol=1e-6)
    np.testing.assert_array_equal(chi2(relaxed, rows)[~is_second], chi2(noisy, rows)[~is_second])
    assert relaxed.missions is noisy.missions


@pytest.mark.parametrize("how", ["together", "each"])
def test_K5_loops_from_outside_take_part_and_are_gone_after(how: str) -> None:
    map_, truth = drive()
    loops = worlds.loops(truth, np.random.default_rng(1), lap=LAP)

    relaxed, report = relax_missions(map_, [0], loops) if how == "each" else relax_map(map_, loops)

    assert report.loops.num_added == len(loops)
    assert relaxed.edges.id.tolist() == map_.edges.id.tolist()
    before = worlds.rmse_m(map_.vertices.T_mission_base, truth)
    assert worlds.rmse_m(relaxed.vertices.T_mission_base, truth) < 0.7 * before


def test_U13_a_false_loop_that_is_believed_is_found_by_its_strain() -> None:
    map_, truth = drive()
    rng = np.random.default_rng(2)
    looped = add_edges(map_, worlds.loops(truth, rng, lap=LAP))
    good, _ = optimize_map(looped, OptimizeConfig(is_robust=False))
    ruined = add_edges(looped, [worlds.false_loop(3, 60, rng)])
    bad, _ = optimize_map(ruined, OptimizeConfig(is_robust=False))
    robust, _ = optimize_map(ruined, OptimizeConfig())

    require_no_worse(looped, good, may_switch=False)
    require_no_worse(ruined, robust)
    assert map_quality(good).worst < 1 < map_quality(bad).worst
    with pytest.raises(EstimationError, match=r"got worse and stays.*sigma \(rms\), 0\.00 before"):
        require_no_worse(ruined, bad, may_switch=False)


def test_U13_covariances_that_were_too_small_before_are_no_fault_of_the_solution() -> None:
    map_, _ = drive()
    tight = replace(map_.edges, covariance=map_.edges.covariance * 1e-6)
    map_ = disturb(replace(map_, edges=tight), Disturbance())
    assert map_quality(map_).worst > 100

    require_no_worse(map_, map_)


def test_L18_a_robot_that_stands_does_not_drift() -> None:
    """Noisy odometry of a robot that stands walks off by centimetres; the tight edges hold it."""
    rng = np.random.default_rng(0)
    truth = [SE3.identity()] * 41
    map_ = Map.empty()
    for submap in worlds.submaps(truth, rng):
        map_ = append_submap(map_, submap)
    wandered = np.linalg.norm(map_.vertices.T_mission_base[:, :3, 3], axis=1).max()

    fixed, report = fix_stationary(map_, StationaryConfig(max_distance_m=0.2, stretch=10))
    solved, _ = optimize_map(fixed, OptimizeConfig())

    assert (report.num_stretches, report.num_standing) == (4, 4)
    held = np.linalg.norm(solved.vertices.T_mission_base[::10, :3, 3], axis=1).max()
    assert wandered > 0.1
    assert held < 0.01
    assert check_map(fixed) == []
    assert (
        fix_stationary(fixed, StationaryConfig(max_distance_m=0.2, stretch=10))[0].digest()
        == fixed.digest()
    )


@pytest.mark.parametrize(
    ("distance_m", "angle_rad", "stands"),
    [(0.099, 0.0, 1), (0.101, 0.0, 0), (0.0, 0.149, 1), (0.0, 0.151, 0)],
)
def test_L18_the_limits_are_ten_centimetres_and_0_15_rad(
    distance_m: float, angle_rad: float, stands: int
) -> None:
    map_ = line_map(2)
    poses = np.stack([np.eye(4), se3_exp([0, 0, angle_rad, 0, 0, 0])])
    poses[1, 0, 3] = distance_m
    map_ = replace(map_, vertices=replace(map_.vertices, T_mission_base=poses))

    assert fix_stationary(map_)[1].num_standing == stands


def test_K9_loops_that_contradict_odometry_are_switched_off_without_solving() -> None:
    map_, truth = drive()
    rng = np.random.default_rng(2)
    looped = add_edges(map_, worlds.loops(truth, rng, lap=LAP))
    false = [worlds.false_loop(a, a + 30, rng) for a in (3, 14, 25)]
    ruined = add_edges(looped, false)

    judged, report = reject_loops(ruined)

    assert report.rejected == [len(looped.edges) + n for n in range(3)]
    assert (report.num_loops, report.num_untouched) == (12, 0)
    assert np.flatnonzero(judged.edges.switch == 0).tolist() == report.rejected
    again, _ = reject_loops(judged)
    assert again.digest() == judged.digest()


def test_K9_loops_between_missions_are_not_judged() -> None:
    both, _ = merge([line_map(4), line_map(4, OTHER_MISSION)])
    ends = replace(worlds.false_loop(0, 0, np.random.default_rng(0)), mission_b=OTHER_MISSION)
    ends = replace(ends, mission_a=MISSION, stamp_a_ns=1_000, stamp_b_ns=1_000)

    judged, report = reject_loops(add_edges(both, [ends]))

    assert (report.num_untouched, report.rejected) == (1, [])
    assert (judged.edges.switch == 1).all()
