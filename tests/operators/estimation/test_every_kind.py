"""One problem with every kind of variable and measurement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.streams.geometry import SE3, invert
from tests.operators.estimation.problems import (
    cov,
    disturbed,
    position_errors_m,
    with_edge,
    with_landmark,
    with_relative,
)
from tests.operators.estimation.test_inertial import flown

MEASURED = cov(0.002, 0.01)


def test_K3_one_problem_holds_every_kind_of_measurement() -> None:
    """Cost falls, poses end near the truth, and each family counts."""
    map_, truth = flown()
    num = len(truth)
    flat = np.diag([np.inf, np.inf, 1e-6, 1e-4, 1e-4, np.inf])
    map_ = with_relative(map_, [(k, k + 1) for k in range(num - 1)], truth, flat, kind="wheel")
    map_ = with_relative(map_, [(0, num - 1)], truth, MEASURED, kind="loop")
    is_loop = map_.edges.kind == "loop"
    map_ = replace(map_, edges=replace(map_.edges, is_switchable=is_loop))
    point, wall = truth[0] @ SE3.from_rotation(np.eye(3), [3.0, 1, 1]).matrix, truth[0].copy()
    map_ = with_landmark(with_landmark(map_, "lidar", point), "plane", wall)
    for k in range(0, num, 2):
        seen = {"vertex_a": k, "covariance": MEASURED}
        map_ = with_edge(map_, "landmark", landmark_a=0, T_a_b=invert(truth[k]) @ point, **seen)
        map_ = with_edge(map_, "plane", landmark_a=1, T_a_b=invert(truth[k]) @ wall, **seen)
        map_ = with_edge(map_, "absolute", T_a_b=truth[k], **seen)
        map_ = with_edge(map_, "position", T_a_b=truth[k], **seen)
    started = disturbed(map_, np.random.default_rng(0), 0.05, 0.3)

    result, report = optimize_map(started, OptimizeConfig(start="current"))

    assert set(report.kinds) >= {"imu", "odometry", "wheel", "loop", "landmark", "plane", "absolute", "position"}  # fmt: skip
    assert report.error_after < 1e-3 * report.error_before
    assert position_errors_m(result, truth).max() < 0.01
    assert not report.ignored
    assert report.is_converged
