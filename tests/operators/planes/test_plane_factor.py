"""What planes determine of poses, and where their outlines grow."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.estimation.determinacy import open_variables
from mapstream.operators.estimation.factors.planes import coefficients
from mapstream.operators.estimation.problem import describe_variable, make_problem
from mapstream.recordings.maps.hulls import hull_of, hull_payload
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, se3_exp, so3_exp
from mapstream.streams.messages.constraints import Constraint, LandmarkRef
from tests.operators.estimation.problems import (
    STEP_NS,
    disturbed,
    position_errors_m,
    with_constraints,
    with_edge,
    with_mission,
)

FLOOR = SE3.from_rotation(np.eye(3), [0.5, 0.2, -1.0])
NORTH = SE3.from_rotation(so3_exp([np.pi / 2, 0, 0]), [0.0, 3.0, 0.0])
EAST = SE3.from_rotation(so3_exp([0, -np.pi / 2, 0]), [4.0, 0.0, 0.0])
SOUTH = SE3.from_rotation(so3_exp([-np.pi / 2, 0, 0]), [0.0, -2.0, 0.0])
TRUTH = np.array([np.eye(4), se3_exp([0.1, -0.2, 0.4, 0.5, 0.3, 0.1])])
INF = np.inf
SEEN = np.diag([1e-4, 1e-4, INF, INF, INF, 1e-4])
LINE = np.diag([INF, 1e-4, INF, INF, INF, 1e-4])


def seen_from(
    poses: FloatArray, planes: dict[str, SE3], covariance: FloatArray = SEEN
) -> list[Constraint]:
    return [
        Constraint(
            stamp_ns=1 + at * STEP_NS,
            kind="plane",
            T_a_b=SE3(pose).inverse() @ plane,
            covariance=covariance,
            landmark=LandmarkRef(name=name, kind="plane"),
            payload=hull_payload(np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])),
        )
        for at, pose in enumerate(poses)
        for name, plane in planes.items()
    ]


def room(planes: dict[str, SE3]) -> Map:
    """Two poses that planes alone connect."""
    map_ = with_constraints(with_mission(TRUTH), seen_from(TRUTH, planes))
    return with_edge(map_, "fixed", vertex_a=0, T_a_b=TRUTH[0])


def test_N2_three_planes_in_general_position_alone_fix_a_pose() -> None:
    map_ = room({"floor": FLOOR, "north": NORTH, "east": EAST})
    rng = np.random.default_rng(1)

    problem = make_problem(map_, OptimizeConfig())
    jacobian, _ = problem.whole_graph().linearize(problem.values).jacobian()
    solved, _ = optimize_map(disturbed(map_, rng, 0.1, 0.3))

    assert np.linalg.matrix_rank(jacobian) == 2 * 6 + 3 * 3
    assert open_variables(problem) == []
    assert position_errors_m(solved, TRUTH).max() < 1e-6


def test_N2_parallel_planes_leave_a_pose_open_and_it_is_named() -> None:
    map_ = room({"north": NORTH, "south": SOUTH})

    problem = make_problem(map_, OptimizeConfig())
    jacobian, _ = problem.whole_graph().linearize(problem.values).jacobian()
    names = [describe_variable(key, map_) for key in open_variables(problem)]

    assert np.linalg.matrix_rank(jacobian) == 2 * 6 + 2 * 3 - 3  # two shifts and a turn
    assert len(names) == 1
    with pytest.raises(EstimationError, match=r"vertex 1.* not determined by the edges"):
        optimize_map(map_)


def test_N2_a_wall_line_counts_however_far_the_laser_leans() -> None:
    """A laser that pitches by 12 deg sees upright walls; its lines put the robot where it is, to rounding."""
    leaning = TRUTH.copy()
    leaning[1] = leaning[1] @ se3_exp([0.15, 0.2, 0, 0, 0, 0])
    walls = {"north": NORTH, "east": EAST}
    lines = [
        replace(c, T_a_b=line_in_level(c.T_a_b), covariance=LINE) for c in seen_from(leaning, walls)
    ]
    map_ = with_constraints(with_mission(leaning), seen_from(leaning[:1], walls) + lines[2:])
    map_ = with_edge(map_, "fixed", vertex_a=0, T_a_b=leaning[0])
    known = np.diag([1e-6, 1e-6, INF, INF, INF, 1e-6])
    map_ = with_edge(
        map_, "absolute", vertex_a=1, T_a_b=leaning[1], covariance=known
    )  # leaning and height

    solved, report = optimize_map(disturbed(map_, np.random.default_rng(2), 0.0, 0.2))

    assert position_errors_m(solved, leaning).max() < 1e-4
    assert report.error_after < 1e-6


def line_in_level(T_base_plane: SE3) -> SE3:
    """Return the wall as its line in the base's x-y plane shows it: x along the line, z in that plane."""
    n, p = T_base_plane.R[:, 2], T_base_plane.t
    along = np.cross(n, [0, 0, 1.0])
    along /= np.linalg.norm(along)
    z = np.cross(along, [0, 0, 1.0])
    z *= np.sign(z @ n)
    on_level = p - p[2] * np.cross(along, n) / np.cross(along, n)[2]
    return SE3.from_rotation(np.column_stack([along, np.cross(z, along), z]), on_level)


def test_N3_the_outline_in_the_map_grows_by_what_is_seen() -> None:
    map_ = room({"floor": FLOOR})
    (before,) = (hull_of(payload) for payload in map_.landmarks.payload)
    more = FLOOR @ SE3.exp([0, 0, 0.3, 2.0, 0, 0])

    grown = with_constraints(map_, seen_from(TRUTH[:1], {"floor": more}))

    (hull,) = (hull_of(payload) for payload in grown.landmarks.payload)
    assert np.ptp(before, axis=0) == pytest.approx([2.0, 2.0])
    in_map = hull @ FLOOR.R[:2, :2].T + FLOOR.t[:2]
    corners = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]) @ more.R[:2, :2].T + more.t[:2]
    for corner in corners:
        outline = in_map.astype(np.float32)
        assert cv2.pointPolygonTest(outline, corner.tolist(), measureDist=True) > -0.02
    assert in_map.min(axis=0) == pytest.approx([-0.5, -0.8], abs=0.02)
    found = coefficients(grown.T_map_landmark(np.arange(1)))
    np.testing.assert_allclose(found, coefficients(FLOOR.matrix[None]), atol=1e-12)
