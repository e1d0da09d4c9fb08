"""Matching of planar scans: points to lines, and on a likelihood grid."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.laser.beams import beam_ends
from mapstream.operators.laser.correlative import LikelihoodGrid, Window
from mapstream.operators.laser.matching import LineTarget, MatchConfig, Prior, match
from mapstream.operators.laser.planar import apply, difference, flattened, lifted, perturbed
from mapstream.operators.laser.surfaces import Surface, surface_of, surface_of_cloud
from mapstream.recordings.worlds.planar_laser import PlanarLaserConfig
from mapstream.recordings.worlds.w_2d import W2dConfig, w_2d
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import LaserScan2D
from mapstream.streams.trajectory import Trajectory
from tests.operators.laser.plane_worlds import CORRIDOR, ROOM, seen_from, surface_from

HERE = np.array([-1.0, 0.5, 0.3])
FAR = MatchConfig(search_distance_m=1.0)


def errors(found: FloatArray, expected: FloatArray) -> FloatArray:
    """Return the error [rad, m] of a pose."""
    apart = difference(expected, found)
    return np.array([abs(apart[0]), np.hypot(apart[1], apart[2])])


@pytest.mark.slow
def test_I14_pairs_of_w_2d_from_20_cm_and_10_deg() -> None:
    """From 0.2 m and 10 deg off, at least 95 % of pairs are within 1 cm and 0.3 deg."""
    laser = PlanarLaserConfig(beams=361, rate_hz=1)
    simulation = w_2d(W2dConfig(width_m=14.0, laps=1, visits=False, laser=laser), 3)
    messages = [record.message for record in simulation.records]
    scans = [m for m in messages if isinstance(m, LaserScan2D)]
    truth = [m for m in messages if isinstance(m, Odometry)]
    way = Trajectory(
        stamps_ns=np.array([m.stamp_ns for m in truth]),
        poses=np.array([m.T_odom_base.matrix for m in truth]),
    )
    seen = [s for s in scans if way.covers(s.stamp_ns) and way.covers(s.end_ns)]
    surfaces = [surface_at(scan, way) for scan in seen]
    poses = [flattened(way.pose_at(scan.end_ns)) for scan in seen]
    rng = np.random.default_rng(7)
    apart = []
    for k in range(1, len(seen)):
        expected = flattened(lifted(poses[k - 1]).inverse() @ lifted(poses[k]))
        direction = rng.uniform(0, 2 * np.pi)
        turn = rng.choice([-1, 1]) * np.radians(10)
        off = np.array([turn, 0.2 * np.cos(direction), 0.2 * np.sin(direction)])
        target = LineTarget(surfaces[k - 1])
        found = match(surfaces[k], target, perturbed(expected, off), FAR)
        apart.append(errors(found.pose, expected))
    good = np.array([a[0] < np.radians(0.3) and a[1] < 0.01 for a in apart])
    assert len(good) >= 40
    assert good.mean() >= 0.95, np.degrees(np.array(apart)[~good])


def surface_at(scan: LaserScan2D, way: Trajectory) -> Surface:
    ends = beam_ends(scan, way)
    return surface_of(ends.points[:, :2], scan.T_base_sensor.t[:2])


@given(
    x=st.floats(-0.3, 0.3),
    y=st.floats(-0.3, 0.3),
    yaw=st.floats(-0.2, 0.2),
)
@settings(max_examples=10, deadline=None)
def test_without_noise_the_pose_is_exact(x: float, y: float, yaw: float) -> None:
    there = HERE + np.array([x, y, yaw])
    expected = flattened(lifted(HERE).inverse() @ lifted(there))

    found = match(surface_from(there), LineTarget(surface_from(HERE)), np.zeros(3), FAR)

    assert found.converged
    assert (errors(found.pose, expected) < [0.005, 0.01]).all()


def test_I14_two_threads_give_identical_results() -> None:
    """Nothing is shared between calls: each result is bit for bit that of a single thread."""
    rng = np.random.default_rng(1)
    target = LineTarget(surface_from(HERE, rng=rng))
    sources = [surface_from(HERE + rng.normal(0, 0.05, 3), rng=rng) for _ in range(12)]

    def matched(source: Surface) -> bytes:
        found = match(source, target, np.zeros(3))
        return found.pose.tobytes() + found.information.tobytes()

    alone = [matched(source) for source in sources]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(matched, [*sources, *sources]))

    assert together == [*alone, *alone]


def test_I14_a_bare_corridor_leaves_its_axis_open() -> None:
    """The variance along it is infinite, and the pose stays where the guess was along it."""
    target = LineTarget(surface_from(np.zeros(3), CORRIDOR, np.random.default_rng(2)))
    source = surface_from(np.zeros(3), CORRIDOR, np.random.default_rng(3))

    found = match(source, target, np.array([0.4, 0.1, 0.05]))

    np.testing.assert_array_equal(np.isinf(np.diagonal(found.covariance)), [False, True, False])
    assert found.pose[0] == pytest.approx(0.4, abs=0.03)
    assert abs(found.pose[1]) < 0.01
    assert abs(found.pose[2]) < 0.005


def test_a_prior_leads_along_the_corridor_and_nowhere_else() -> None:
    target = LineTarget(surface_from(np.zeros(3), CORRIDOR, np.random.default_rng(2)))
    source = surface_from(np.zeros(3), CORRIDOR, np.random.default_rng(3))
    prior = Prior(np.array([0.7, 0.2, 0.1]), np.diag([100.0, 100.0, 100.0]))

    found = match(source, target, np.array([0.4, 0.1, 0.05]), prior=prior)

    assert found.pose[0] == pytest.approx(0.7, abs=0.05)
    assert abs(found.pose[1]) < 0.02


def test_the_covariance_is_that_of_the_errors() -> None:
    """Over many draws of the noise, errors are of the size that the covariance says, within a factor."""
    rng = np.random.default_rng(4)
    target = LineTarget(surface_from(HERE))
    drawn = [match(surface_from(HERE, rng=rng), target, np.zeros(3)) for _ in range(30)]

    spread = np.std([difference(np.zeros(3), m.pose) for m in drawn], axis=0)
    said = np.sqrt(np.diagonal(drawn[0].covariance))

    assert (spread < said).all()
    assert (spread > said / 12).all()


def test_things_that_moved_do_not_pull() -> None:
    """A fifth of the beams end on somebody who walked by."""
    points = seen_from(HERE, rng=np.random.default_rng(5))
    points[20:56] *= 0.6
    found = match(surface_of(points, np.zeros(2)), LineTarget(surface_from(HERE)), np.zeros(3))

    assert (errors(found.pose, np.zeros(3)) < [0.005, 0.01]).all()
    assert found.inlier_fraction < 0.9


def test_the_two_sides_of_a_wall_do_not_match() -> None:
    """A wall seen from the north is not the same wall seen from the south, a hand's breadth away."""
    wall = np.array([[-3.0, 1.0], [3.0, 1.0]])[None]
    north = surface_of(seen_from(np.array([0, 3.0, -np.pi / 2]), wall), np.zeros(2))
    south = surface_of(seen_from(np.array([0, -1.0, np.pi / 2]), wall), np.zeros(2))

    found = match(
        south,
        LineTarget(north.moved(np.array([0, 3.1, -np.pi / 2]))),
        np.array([0, -1.0, np.pi / 2]),
    )

    assert found.inlier_fraction == 0.0


def test_too_few_points_are_an_error() -> None:
    few = Surface(np.zeros((3, 2)), np.zeros((3, 2)))
    with pytest.raises(EstimationError, match="scans of 3 points"):
        match(few, LineTarget(surface_from(HERE)), np.zeros(3))


def test_points_in_any_order_lie_on_the_same_lines() -> None:
    """The lines of a shuffled cloud are those of the scan, but for the sides."""
    points = seen_from(HERE, rng=np.random.default_rng(6))
    ordered = surface_of(points, np.zeros(2))
    cloud = surface_of_cloud(points)

    both = np.isfinite(ordered.normals[:, 0]) & np.isfinite(cloud.normals[:, 0])
    agreement = np.abs(np.einsum("nc,nc->n", ordered.normals[both], cloud.normals[both]))
    assert both.mean() > 0.7
    assert np.quantile(agreement, 0.1) > 0.9


@given(st.floats(-2.5, 2.5), st.floats(-2.5, 2.5), st.floats(-0.5, 0.5))
@settings(max_examples=8, deadline=None)
def test_a_likelihood_grid_finds_the_basin(x: float, y: float, yaw: float) -> None:
    """However far within the window the guess is, the match that starts there ends at the pose."""
    target, source = surface_from(HERE), seen_from(HERE)
    guess = np.array([x, y, yaw])

    basin = LikelihoodGrid(target.points).search(source, guess, Window(radius_m=2.6, turn_rad=0.55))

    found = match(surface_of(source, np.zeros(2)), LineTarget(target), basin.pose)
    assert (errors(found.pose, np.zeros(3)) < [0.005, 0.01]).all()


def test_the_bounded_search_finds_what_looking_everywhere_finds() -> None:
    rng = np.random.default_rng(8)
    grid = LikelihoodGrid(rng.uniform(-2, 2, (60, 2)))
    points = rng.uniform(-2, 2, (25, 2))
    window = Window(radius_m=0.2, turn_rad=0.05, turn_step_rad=0.05)
    guess = np.array([0.1, -0.2, 0.3])

    basin = grid.search(points, guess, window)

    def score(pose: FloatArray) -> float:
        return grid.search(points, pose, Window(radius_m=0.0, turn_rad=0.0)).score

    everywhere = [
        score(guess + np.array([0.05 * i, 0.05 * j, 0.05 * k]))
        for i in range(-4, 5)
        for j in range(-4, 5)
        for k in range(-1, 2)
    ]
    assert basin.score == pytest.approx(max(everywhere), abs=0.02)  # cells are rounded otherwise


def test_planar_poses_are_those_of_space() -> None:
    pose, tangent = np.array([1.0, -2.0, 0.7]), np.array([0.2, 0.5, -0.3])
    moved = perturbed(pose, tangent)

    np.testing.assert_allclose(difference(pose, moved), tangent, atol=1e-12)
    np.testing.assert_allclose(flattened(lifted(moved)), moved, atol=1e-12)
    step = SE3.from_rotation(np.eye(3), [*tangent[1:], 0.0])
    np.testing.assert_allclose((lifted(pose) @ step).t[:2], moved[:2], atol=1e-12)
    np.testing.assert_allclose(apply(pose, np.zeros((1, 2)))[0], pose[:2])
    assert ROOM.shape[1:] == (2, 2)
