"""Walls that only a planar laser saw: a map of them is determined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapstream.operators.estimation.batch import optimize_map
from mapstream.operators.estimation.factors.planes import coefficients
from tests.operators.estimation.problems import (
    disturbed,
    position_errors_m,
    with_constraints,
    with_edge,
    with_mission,
)
from tests.operators.planes.test_plane_factor import (
    EAST,
    INF,
    LINE,
    NORTH,
    TRUTH,
    line_in_level,
    seen_from,
)


def test_E15_walls_seen_as_lines_alone_stand_upright() -> None:
    """On level ground no line says how a wall leans; it stays as upright as it was seen, and holds the poses."""
    poses = TRUTH.copy()
    poses[1, :3, :3] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    poses[1, 2, 3] = 0.0
    lines = [
        replace(c, T_a_b=line_in_level(c.T_a_b), covariance=LINE)
        for c in seen_from(poses, {"north": NORTH, "east": EAST})
    ]
    map_ = with_edge(
        with_constraints(with_mission(poses), lines), "fixed", vertex_a=0, T_a_b=poses[0]
    )
    level = np.diag([1e-6, 1e-6, INF, INF, INF, 1e-6])
    map_ = with_edge(map_, "absolute", vertex_a=1, T_a_b=poses[1], covariance=level)

    solved, _ = optimize_map(disturbed(map_, np.random.default_rng(3), 0.0, 0.2))

    assert position_errors_m(solved, poses).max() < 1e-3
    normals = coefficients(solved.T_map_landmark(np.arange(2)))[:, :3]
    np.testing.assert_allclose(normals[:, 2], 0.0, atol=1e-3)
