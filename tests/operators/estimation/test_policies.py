"""What a user may ask of an optimisation: who takes part, which loss, which solver, how long, how certain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.estimation.covariance import covariances
from mapstream.operators.estimation.factors.planes import coefficients
from mapstream.operators.estimation.optimize_config import Loss
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import invert, se3_exp, se3_log
from tests.operators.estimation.problems import (
    cov,
    disturbed,
    position_errors_m,
    wander,
    with_edge,
    with_landmark,
    with_mission,
    with_relative,
)

NUM = 30
TIGHT, LOOSE = cov(0.001, 0.01), cov(0.01, 0.05)


def ring(seed: int = 0, num: int = NUM) -> tuple[Map, FloatArray]:
    """A chain of odometry with loops over five poses, both noisy."""
    rng = np.random.default_rng(seed)
    truth = wander(num, rng)
    map_ = with_mission(truth)
    map_ = with_relative(map_, [(k, k + 1) for k in range(num - 1)], truth, LOOSE, rng=rng)
    pairs = [(k, k + 5) for k in range(num - 5)]
    return with_relative(map_, pairs, truth, LOOSE, rng=rng, kind="loop"), truth


def test_K6_each_family_of_residuals_takes_part_or_not() -> None:
    map_, _ = ring()

    _, all_of_them = optimize_map(map_)
    _, by_name = optimize_map(map_, OptimizeConfig(kinds=("odometry",)))
    _, without = optimize_map(map_, OptimizeConfig(without=("loop",)))

    assert all_of_them.num_edges == {"loop": NUM - 5, "odometry": NUM - 1}
    assert by_name.num_edges == without.num_edges == {"odometry": NUM - 1}
    assert by_name.ignored == without.ignored == {"loop": NUM - 5}
    assert by_name.error_after == pytest.approx(0, abs=1e-6)  # a chain contradicts nothing


@pytest.mark.parametrize("loss", ["huber", "cauchy", "geman_mcclure", "tukey"])
def test_K7_a_loss_by_kind_withstands_gross_outliers(loss: Loss) -> None:
    """A fifth of the loops is grossly wrong: the error is below 1.5 times that without these."""
    map_, truth = ring(1, num=60)
    clean, _ = optimize_map(map_)
    loops = map_.edges_of("loop")
    wrong = loops[::5]
    T = map_.edges.T_a_b.copy()
    T[wrong] = T[wrong] @ se3_exp(
        np.random.default_rng(2).normal(0, [0.2] * 3 + [3.0] * 3, (len(wrong), 6))
    )
    spoiled = replace(map_, edges=replace(map_.edges, T_a_b=T))

    plain, _ = optimize_map(spoiled, OptimizeConfig(start="current"))
    robust, _ = optimize_map(spoiled, OptimizeConfig(start="current", losses={"loop": loss}))

    def rms(result: Map) -> float:
        return float(np.sqrt((position_errors_m(result, truth) ** 2).mean()))

    assert rms(robust) < 1.5 * rms(clean)
    assert rms(plain) > 3 * rms(clean)


@pytest.mark.slow
def test_K10_covariances_are_those_of_monte_carlo() -> None:
    """Standard deviations of 400 runs are within 20 %."""
    num, runs = 8, 400
    rng = np.random.default_rng(9)
    truth = wander(num, rng)
    pairs = [(k, k + 1) for k in range(num - 1)]
    errors = []
    result = Map.empty()
    for _ in range(runs):
        map_ = with_relative(with_mission(truth), pairs, truth, LOOSE, rng=rng)
        map_ = with_relative(map_, [(0, 4), (2, 7)], truth, LOOSE, rng=rng, kind="loop")
        result, _ = optimize_map(map_, OptimizeConfig(start="current"))
        errors.append(se3_log(invert(truth) @ result.T_map_base(np.arange(num))))
    sampled = np.std(np.array(errors)[:, [3, 7]], axis=0)

    found = covariances(result, [3, 7])

    sigmas = np.sqrt(np.diagonal(found, axis1=1, axis2=2))
    np.testing.assert_allclose(sigmas, sampled, rtol=0.2)


def test_K10_a_state_outside_the_problem_is_named() -> None:
    map_, _ = ring()

    with pytest.raises(EstimationError, match="no edge constrains the velocity in row 3"):
        covariances(map_, [3], variable="velocity")


def test_K13_a_second_run_begins_with_the_damping_of_the_first() -> None:
    map_, _ = ring(3, num=60)
    far = disturbed(map_, np.random.default_rng(0), 0.4, 2.0)
    config = OptimizeConfig(start="current", initial_lambda=1e5, is_robust=False)
    _, first = optimize_map(far, config)

    _, again = optimize_map(far, config.model_copy(update={"initial_lambda": first.final_lambda}))

    assert first.final_lambda < 1e5
    assert again.iterations < first.iterations
    assert again.error_after == pytest.approx(first.error_after, rel=1e-4)


def test_K13_caps_on_iterations_and_time_are_kept_and_told() -> None:
    far = disturbed(ring()[0], np.random.default_rng(0), 0.4, 2.0)

    _, one = optimize_map(far, OptimizeConfig(start="current", max_iterations=1))
    _, late = optimize_map(far, OptimizeConfig(start="current", max_seconds=1e-9))
    _, free = optimize_map(far, OptimizeConfig(start="current"))

    assert (one.iterations, one.is_converged) == (1, False)
    assert (late.iterations, late.is_converged) == (0, False)
    assert free.is_converged
    assert any("cap" in line for line in one.lines())


@pytest.mark.parametrize("solver", ["dogleg", "sparse"])
def test_K14_other_solvers_end_at_the_same_cost(solver: str) -> None:
    """Equal to 1e-6, from a disturbed start; `sparse` shares no residual and no solver with gtsam."""
    far = disturbed(ring()[0], np.random.default_rng(4), 0.1, 0.5)
    fine = OptimizeConfig(start="current")
    once, _ = optimize_map(far, fine)
    _, gtsam_lm = optimize_map(
        once, fine
    )  # a second descent ends closer to the minimum than gtsam's tolerance
    other, _ = optimize_map(far, fine.model_copy(update={"solver": solver}))

    _, report = optimize_map(other, fine.model_copy(update={"solver": solver}))

    assert report.error_after == pytest.approx(gtsam_lm.error_after, rel=1e-6)
    assert report.solver == solver


def test_K14_the_sparse_solver_says_what_it_does_not_know() -> None:
    map_, _ = ring()
    map_ = with_edge(map_, "position", vertex_a=2, covariance=np.diag([np.inf] * 3 + [0.01] * 3))

    with pytest.raises(EstimationError, match="knows poses alone"):
        optimize_map(map_, OptimizeConfig(solver="sparse", underconstrained="prior"))


def test_K15_variables_that_are_left_open_are_named() -> None:
    """Wheels leave z, roll and pitch open, of every pose but the first."""
    rng = np.random.default_rng(0)
    truth = wander(4, rng)
    flat = np.diag([np.inf, np.inf, 1e-6, 1e-4, 1e-4, np.inf])
    map_ = with_relative(with_mission(truth), [(0, 1), (1, 2), (2, 3)], truth, flat, kind="wheel")

    with pytest.raises(EstimationError, match=r"the pose at .* ns of mission .* not determined"):
        optimize_map(map_)
    result, report = optimize_map(map_, OptimizeConfig(underconstrained="prior"))

    assert [int(name.split("vertex ")[1].rstrip(")")) for name in report.underconstrained] == [
        1,
        2,
        3,
    ]
    assert np.isfinite(result.vertices.T_mission_base).all()
    assert position_errors_m(result, truth).max() < 1e-3
    assert any("weak prior" in line for line in report.lines())


def test_K15_one_fix_leaves_the_heading_open() -> None:
    """Positions at one place say nothing of where the robot looks."""
    map_, _ = ring()
    fix = {"covariance": np.diag([np.inf] * 3 + [0.01] * 3), "T_a_b": np.eye(4)}
    map_ = with_edge(map_, "position", vertex_a=0, **fix)

    with pytest.raises(EstimationError, match=r"vertex 0.* not determined by the edges"):
        optimize_map(map_)
    _, report = optimize_map(map_, OptimizeConfig(underconstrained="prior"))

    assert len(report.underconstrained) == NUM


@pytest.mark.parametrize(
    "open_variance", [(np.inf, np.inf, 1e-4), (1e-4, 1e-4, np.inf), (1e-4, np.inf, 1e-4)]
)
def test_K15_a_plane_that_is_open_in_a_direction_is_named_and_stays_there(
    open_variance: tuple[float, float, float],
) -> None:
    """Tilts about x and y, and the shift along the normal: what no edge measures keeps its guess."""
    map_, _ = ring()
    place = se3_exp([0.0, 0.0, 0.0, 2.0, 1.0, -1.0])
    map_ = with_landmark(map_, "plane", place)
    tilt_x, tilt_y, shift = open_variance
    covariance = np.diag([tilt_x, tilt_y, np.inf, np.inf, np.inf, shift])
    seen = invert(map_.T_map_base(np.array([0])))[0] @ place
    map_ = with_edge(map_, "plane", vertex_a=0, landmark_a=0, T_a_b=seen, covariance=covariance)

    with pytest.raises(EstimationError, match=r"the landmark in row 0: not determined"):
        optimize_map(map_)
    result, report = optimize_map(map_, OptimizeConfig(underconstrained="prior"))

    assert report.underconstrained == ["the landmark in row 0"]
    alone, _ = optimize_map(map_.select(edges=map_.edges.kind != "plane"))
    np.testing.assert_allclose(
        result.vertices.T_mission_base, alone.vertices.T_mission_base, atol=1e-6
    )
    found = coefficients(result.T_map_landmark(np.array([0])))
    np.testing.assert_allclose(found, coefficients(place[None]), atol=1e-3)


def test_F15_a_mission_without_a_base_frame_moves_no_other() -> None:
    """Apart, poses of the mission that is known are bit for bit those without the other mission."""
    map_, truth = ring(5)
    known = replace(map_, missions=replace(map_.missions, is_base_frame_known=np.array([True])))
    alone, _ = optimize_map(known)
    both = with_mission(truth, known, mission="ab" * 16)
    both = with_relative(
        both,
        [(NUM + k, NUM + k + 1) for k in range(NUM - 1)],
        np.concatenate([truth, truth]),
        LOOSE,
    )
    off = np.eye(4)
    off[0, 3] = 50.0
    for k in (0, 10, 20):
        both = with_edge(both, "loop", vertex_a=k, vertex_b=NUM + k, T_a_b=off, covariance=TIGHT)
    both = with_edge(
        both, "loop", vertex_a=0, vertex_b=2 * NUM - 1, T_a_b=np.eye(4), covariance=TIGHT
    )

    apart, report = optimize_map(both, OptimizeConfig(unanchored="apart"))
    joined, _ = optimize_map(both)

    rows = np.arange(NUM)
    np.testing.assert_allclose(apart.T_map_base(rows), alone.T_map_base(rows), atol=1e-9)
    assert report.ignored == {"loop": 4}
    assert np.abs(joined.T_map_base(rows) - alone.T_map_base(rows)).max() > 0.1
    assert apart.missions.is_base_frame_known.tolist() == [True, False]
