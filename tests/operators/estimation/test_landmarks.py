"""Landmarks of all shapes, ranges, and relations between landmarks: solved from random starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.estimation.factors import planes
from mapstream.operators.estimation.kinds import make_factors
from mapstream.operators.estimation.noise import NoiseModels
from mapstream.operators.estimation.starts.landmark_starts import averaged_landmarks
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Observations
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.constraints import Constraint, LandmarkRef, OuterFrame
from tests.operators.estimation.problems import (
    STEP_NS,
    Solved,
    cov,
    disturbed,
    position_errors_m,
    wander,
    with_constraints,
    with_edge,
    with_landmark,
    with_mission,
    with_relative,
)

PLACES = np.array([se3_exp([*turn, *place]) for turn, place in (
    ([0.1, 0.2, 0.3], [3.0, 2.0, 1.0]),
    ([0.5, -0.2, 1.0], [2.0, -3.0, 0.5]),
    ([-0.3, 0.4, 2.0], [6.0, 1.0, -1.0]),
)])  # fmt: skip


def observed(
    truth: FloatArray, kind: str, rng: np.random.Generator, sigmas: tuple[float, float]
) -> list[Constraint]:
    """Each place seen from each pose, with noise [rad, m]; lines where they cross the plane of the base."""
    made = []
    for at, pose in enumerate(truth):
        for name, place in enumerate(PLACES):
            seen = np.linalg.inv(pose) @ place
            if kind == "point2d":
                seen[:3, :3] = np.eye(3)
                seen[:3, 3] -= seen[2, 3] / pose[2, 2] * pose[2, :3]
            made.append(
                Constraint(
                    stamp_ns=1 + at * STEP_NS,
                    kind="landmark",
                    T_a_b=SE3(seen) @ SE3.exp(rng.normal(size=6) * np.repeat(sigmas, 3)),
                    covariance=cov(*sigmas),
                    landmark=LandmarkRef(name=str(name), kind=kind),
                )
            )
    return made


def with_landmarks_moved(map_: Map, rng: np.random.Generator, distance_m: float) -> Map:
    moves = rng.normal(size=(len(map_.landmarks), 3))
    moves *= distance_m / np.linalg.norm(moves, axis=1)[:, None]
    moved = replace(map_.landmarks, p_base=map_.landmarks.p_base + moves)
    return replace(map_, landmarks=moved)


@pytest.mark.parametrize("kind", ["point", "visual", "point2d", "pose"])
@pytest.mark.parametrize("seed", range(2))
def test_E1_E4_E12_F12_landmarks_seen_five_times_converge_from_half_a_metre(
    kind: str, seed: int
) -> None:
    """Poses and landmarks both get better than odometry alone, whatever shape the landmarks have."""
    rng = np.random.default_rng(seed)
    truth = wander(5, rng)
    chain = [(a, a + 1) for a in range(4)]
    map_ = with_relative(with_mission(truth), chain, truth, cov(0.01, 0.05), rng=rng)
    alone = Solved(map_).map.vertices.T_mission_base - truth
    map_ = with_constraints(map_, observed(truth, kind, rng, (0.005, 0.01)))
    started = with_landmarks_moved(disturbed(map_, rng, 0.03, 0.2), rng, 0.5)

    solved = Solved(started)

    assert len(solved.factors) == 4 + 15
    num_measured = {"pose": 90, "point2d": 30}.get(kind, 45)
    num_found = {"pose": 18, "point2d": 6}.get(kind, 9)
    assert solved.chi2 < 2 * (num_measured - num_found)
    errors = solved.map.T_map_landmark(np.arange(3)) - PLACES
    shown = slice(0, 2 if kind == "point2d" else 3)  # a vertical line has no height
    assert np.linalg.norm(errors[:, shown, 3], axis=1).max() < 0.05
    both = solved.map.vertices.T_mission_base - truth
    together_m, alone_m = (np.linalg.norm(each[:, shown, 3], axis=1) for each in (both, alone))
    assert together_m.mean() < 0.7 * alone_m.mean()
    if kind == "pose":
        assert np.abs(errors[:, :3, :3]).max() < 0.02


def test_E3_a_point_begins_at_the_mean_of_its_observations() -> None:
    rng = np.random.default_rng(5)
    truth = wander(5, rng)
    seen = observed(truth, "point", rng, (0.01, 0.1))
    map_ = with_constraints(with_mission(truth), seen)
    in_map = np.array([truth[(c.stamp_ns - 1) // STEP_NS] @ c.T_a_b.matrix for c in seen])[:, :3, 3]
    extra = np.array([[1.0, 2.0, 3.0]], dtype=np.float32)
    lidar = Observations(
        vertex=np.array([2]),
        landmark=np.array([0]),
        sensor=np.array(["lidar"], object),
        p_sensor=extra,
    )

    starts = averaged_landmarks(map_).T_map_landmark(np.arange(3))[:, :3, 3]
    more = averaged_landmarks(replace(map_, observations=lidar)).T_map_landmark(np.arange(3))

    np.testing.assert_allclose(starts, in_map.reshape(5, 3, 3).mean(axis=0), atol=1e-9)
    sixth = truth[2, :3, :3] @ extra[0] + truth[2, :3, 3]
    np.testing.assert_allclose(more[0, :3, 3], (5 * starts[0] + sixth) / 6, atol=1e-6)


def test_E3_an_optimisation_may_begin_with_the_means() -> None:
    rng = np.random.default_rng(6)
    truth = wander(5, rng)
    map_ = with_relative(
        with_mission(truth), [(a, a + 1) for a in range(4)], truth, cov(0.01, 0.05), rng=rng
    )
    map_ = with_constraints(map_, observed(truth, "point", rng, (0.005, 0.01)))
    far = with_landmarks_moved(map_, rng, 50.0)

    optimised, report = optimize_map(far, OptimizeConfig(start_landmarks="mean"))

    assert report.error_before < optimize_map(far)[1].error_before / 100
    found = optimised.T_map_landmark(np.arange(3))[:, :3, 3]
    assert np.linalg.norm(found - PLACES[:, :3, 3], axis=1).max() < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_F17_a_robot_among_beacons(seed: int) -> None:
    """Ranges of 2 cm from an antenna 0.5 m off the base to four beacons of known place."""
    rng = np.random.default_rng(seed)
    truth = wander(10, rng)
    beacons = np.array([[6.0, 5, 2], [-4, 6, -1], [3, -7, 1], [5, 2, 6]])
    antenna = SE3.from_rotation(np.eye(3), [0.3, 0.0, 0.4])
    map_ = with_mission(truth)
    map_ = with_relative(map_, [(a, a + 1) for a in range(9)], truth, cov(0.005, 0.05), rng=rng)
    for place in beacons:
        map_ = with_landmark(map_, "beacon", SE3.from_rotation(np.eye(3), place).matrix)
        map_ = with_edge(
            map_,
            "position",
            landmark_a=len(map_.landmarks) - 1,
            T_a_b=SE3.from_rotation(np.eye(3), place).matrix,
            covariance=cov(np.inf, 0.001),
        )
    for row, pose in enumerate(truth):
        for beacon, place in enumerate(beacons):
            range_m = np.linalg.norm((SE3(pose) @ antenna).t - place) + rng.normal(0, 0.02)
            map_ = with_edge(
                map_,
                "range",
                vertex_a=row,
                landmark_a=beacon,
                covariance=cov(np.inf, 0.02),
                payload={"range_m": range_m, "T_base_sensor": [0.3, 0, 0.4, 0, 0, 0, 1]},
            )

    solved = Solved(disturbed(map_, rng, 0.05, 0.5), hold=())

    errors = position_errors_m(solved.map, truth)
    assert np.sqrt((errors**2).mean()) < 0.05


WALLS = (  # rotation vectors that turn z to the normals of a room's walls, and where they are
    ([0.0, -np.pi / 2, 0.0], [4.0, 0.0, 0.0]),
    ([0.0, np.pi / 2, 0.0], [-4.0, 1.0, 0.0]),
    ([np.pi / 2, 0.0, 0.0], [0.0, 3.0, 0.5]),
    ([-np.pi / 2, 0.0, 0.0], [1.0, -3.0, 0.0]),
    ([0.0, 0.0, 0.0], [0.0, 0.0, -1.0]),
)


def room(seed: int, *, sigma_rad: float = 0.02) -> tuple[Map, FloatArray, np.random.Generator]:
    """Walls and a floor, seen from poses inside with noise of 2 cm; patches lie anywhere on the walls."""
    rng = np.random.default_rng(seed)
    truth = np.array([se3_exp([0, 0, 0.4 * k, 0.3 * k - 1, 0.2 * k, 0]) for k in range(6)])
    map_ = with_relative(
        with_mission(truth), [(a, a + 1) for a in range(5)], truth, cov(0.005, 0.02), rng=rng
    )
    covariance = np.diag([sigma_rad**2, sigma_rad**2, np.inf, np.inf, np.inf, 0.02**2])
    made = []
    for at, pose in enumerate(truth):
        for wall in range(len(WALLS)):
            patch = wall_pose(wall) @ se3_exp([0, 0, rng.uniform(-3, 3), *rng.uniform(-1, 1, 2), 0])
            error = [*rng.normal(0, sigma_rad, 2), 0, 0, 0, rng.normal(0, 0.02)]
            made.append(
                Constraint(
                    stamp_ns=1 + at * STEP_NS,
                    kind="plane",
                    T_a_b=SE3(np.linalg.inv(pose) @ patch) @ SE3.exp(error),
                    covariance=covariance,
                    landmark=LandmarkRef(name=str(wall), kind="plane"),
                )
            )
    return with_constraints(map_, made), truth, rng


def wall_pose(wall: int) -> FloatArray:
    turn, place = WALLS[wall]
    return SE3.from_rotation(SE3.exp([*turn, 0, 0, 0]).R, place).matrix


def normals(map_: Map) -> FloatArray:
    return planes.coefficients(map_.T_map_landmark(np.arange(len(map_.landmarks))))


def angles_between_walls(map_: Map) -> FloatArray:
    """How far the walls are from being square or parallel, of all pairs [rad]."""
    n = normals(map_)[:, :3]
    angles = np.arccos(np.clip(np.abs(n @ n.T)[np.triu_indices(len(n), 1)], 0, 1))
    return np.asarray(np.minimum(angles, np.pi / 2 - angles))


@pytest.mark.parametrize("seed", range(2))
def test_planes_hold_a_robot_in_a_room(seed: int) -> None:
    map_, truth, rng = room(seed, sigma_rad=0.01)
    alone = Solved(map_.select(edges=map_.edges.kind == "odometry"))

    solved = Solved(disturbed(map_, rng, 0.05, 0.2))

    assert position_errors_m(solved.map, truth).max() < 0.05
    assert solved.chi2 < 2 * (6 * 5 * 3 - 5 * 3)
    true = np.array([planes.coefficients(wall_pose(wall)) for wall in range(len(WALLS))])
    found = normals(solved.map)
    assert np.abs(found[:, 3] - true[:, 3]).max() < 0.06
    assert np.rad2deg(np.arccos((found[:, :3] * true[:, :3]).sum(axis=1))).max() < 1.0
    assert position_errors_m(solved.map, truth).mean() < position_errors_m(alone.map, truth).mean()


@pytest.mark.parametrize("seed", range(3))
def test_F14_walls_known_to_be_square_are_square_and_nearer_to_the_truth(seed: int) -> None:
    map_, _, rng = room(seed)
    free = Solved(disturbed(map_, rng, 0.02, 0.1))
    tight = cov(1e-4, 1e-4)
    tied = map_
    for a in range(5):
        for b in range(a + 1, 5):
            kind = "parallel" if (a, b) in ((0, 1), (2, 3)) else "perpendicular"
            tied = with_edge(tied, kind, landmark_a=a, landmark_b=b, covariance=tight)

    solved = Solved(disturbed(tied, rng, 0.02, 0.1))

    assert np.rad2deg(angles_between_walls(solved.map).max()) < 0.1
    true = np.array([planes.coefficients(wall_pose(wall)) for wall in range(len(WALLS))])[:, :3]
    errors = [
        np.arccos(np.clip((normals(each.map)[:, :3] * true).sum(axis=1), -1, 1))
        for each in (free, solved)
    ]
    assert angles_between_walls(solved.map).mean() < 0.7 * angles_between_walls(free.map).mean()
    assert np.sqrt((errors[1] ** 2).mean()) < np.sqrt((errors[0] ** 2).mean())


@pytest.mark.parametrize("seed", range(2))
def test_F14_points_lie_on_their_plane_and_two_walls_are_one(seed: int) -> None:
    map_, truth, _ = room(seed)
    tight = cov(1e-4, 1e-4)
    second = wall_pose(4) @ se3_exp([0.01, 0.02, 0, 1.0, 0.5, 0.03])  # another part of the floor
    map_ = with_landmark(map_, "plane", second)
    seen = SE3(np.linalg.inv(truth[0]) @ second).matrix
    loose = np.diag([4e-4, 4e-4, np.inf, np.inf, np.inf, 4e-4])
    map_ = with_edge(map_, "plane", vertex_a=0, landmark_a=5, T_a_b=seen, covariance=loose)
    map_ = with_edge(map_, "coplanar", landmark_a=4, landmark_b=5, covariance=tight)
    for k in range(4):
        place = wall_pose(0) @ se3_exp([0, 0, 0, k - 1.0, 0.5 * k, 0.05])
        map_ = with_landmark(map_, "lidar", place)
        point = np.linalg.inv(truth[1]) @ place
        covariance = cov(np.inf, 0.02)
        map_ = with_edge(
            map_, "landmark", vertex_a=1, landmark_a=6 + k, T_a_b=point, covariance=covariance
        )
        map_ = with_edge(map_, "point_on_plane", landmark_a=6 + k, landmark_b=0, covariance=tight)

    solved = Solved(map_)

    found = normals(solved.map)
    points = solved.map.T_map_landmark(np.arange(6, 10))[:, :3, 3]
    assert np.abs(points @ found[0, :3] + found[0, 3]).max() < 1e-3
    assert np.rad2deg(np.arccos(np.clip(found[4, :3] @ found[5, :3], -1, 1))) < 0.1
    assert abs(found[4, 3] - found[5, 3]) < 1e-3


def test_a_plane_seen_from_behind_is_the_same_plane() -> None:
    map_, truth, _ = room(1)
    wall = wall_pose(0) @ se3_exp([np.pi, 0, 0, 0, 0, 0])  # the normal points the other way
    seen = np.linalg.inv(truth[0]) @ wall
    covariance = np.diag([1e-4, 1e-4, np.inf, np.inf, np.inf, 1e-4])
    map_ = with_edge(map_, "plane", vertex_a=0, landmark_a=0, T_a_b=seen, covariance=covariance)
    row = len(map_.edges) - 1

    solved = Solved(map_)

    assert 2 * solved.factors[row].error(solved.values) < 16


def test_edges_on_the_wrong_ends_are_refused() -> None:
    """Each by name, with what it needs."""
    map_ = with_mission(wander(2, np.random.default_rng(1)))
    map_ = with_landmark(with_landmark(map_, "point", np.eye(4)), "point", np.eye(4))
    frame = Constraint(
        stamp_ns=1, kind="position", outer=OuterFrame(name="room"), covariance=cov(1, 1)
    )
    map_ = with_constraints(map_, [frame])
    nan = np.full((4, 4), np.nan)
    for kind, columns, message in (
        ("parallel", {"landmark_a": 0, "landmark_b": 1}, "is between plane and plane, not"),
        ("range", {"vertex_a": 0, "payload": {"range_m": 1.0}}, "needs a landmark_a"),
        ("range", {"vertex_a": 0, "landmark_a": 0}, '"range_m"'),
        ("odometry", {"vertex_a": 0}, "needs a vertex_b"),
        ("odometry", {"vertex_a": 0, "vertex_b": 1, "T_a_b": nan}, "transform is not finite"),
        ("imu", {"vertex_a": 0}, "needs a vertex_b"),
        ("gravity", {"landmark_a": 0, "payload": {"up": [0, 0, 1]}}, "needs a vertex_a"),
        ("gravity", {"vertex_a": 0, "payload": {"up": [0, 1]}}, '"up"'),
        ("absolute", {"landmark_a": 0}, "can be measured of a pose"),
        ("position", {"landmark_a": 0, "frame": 0}, "in a frame that is known"),
        ("position", {}, "needs a landmark_a"),
        ("landmark", {"vertex_a": 0}, "needs a landmark_a"),
    ):
        wrong = with_edge(map_, kind, covariance=cov(1, 1), **columns)

        with pytest.raises(EstimationError, match=message):
            make_factors(wrong, [len(wrong.edges) - 1], NoiseModels())


def test_payloads_that_are_not_what_they_seem_are_refused() -> None:
    map_ = with_mission(wander(2, np.random.default_rng(1)))
    for payload, message in (
        (b"{", "its payload is no JSON object"),
        (b"[1]", "its payload is no JSON object"),
        (b'{"T_base_sensor": [1, 2]}', "qx, qy, qz, qw"),
        (b'{"T_base_sensor": [0, 0, 0, 0, 0, 0, 0]}', "qx, qy, qz, qw"),
    ):
        wrong = with_edge(map_, "absolute", vertex_a=0, covariance=cov(1, 1))
        edges = replace(wrong.edges, payload=np.array([payload], dtype=object))

        with pytest.raises(EstimationError, match=message):
            make_factors(replace(wrong, edges=edges), [0], NoiseModels())
