"""Wall lines of a planar laser: as exact as they say, and where the walls are."""

from __future__ import annotations

from itertools import islice
from typing import Any

import numpy as np
import pytest

from mapstream.operators.laser.laser_lines import LaserLines, LaserLinesConfig
from mapstream.operators.laser.lines import LineConfig, find_lines
from mapstream.operators.testing import run_operator
from mapstream.recordings.worlds.w_2d import W2dConfig, w_2d, w_2d_floor
from mapstream.streams.arrays import FloatArray
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.planes import PlaneSegments
from mapstream.streams.messages.sensors import LaserScan2D
from mapstream.streams.trajectory import Trajectory

SMALL: dict[str, Any] = {"width_m": 14.0, "laps": 0.2, "wheels_hz": 1.0}


def room(rng: np.random.Generator, sigma_m: float = 0.01) -> FloatArray:
    """Return points (N, 2) of a laser that looks around, 2 m from the left and 1 m from the lower wall of 6 x 4 m."""
    angles = np.linspace(-2.3, 2.3, 500)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    walls = np.array([[1, 0, 4], [-1, 0, 2], [0, 1, 3], [0, -1, 1]])  # normal, distance
    reach = np.where(rays @ walls[:, :2].T > 0, walls[:, 2] / (rays @ walls[:, :2].T), np.inf)
    ranges = reach.min(axis=1) + rng.normal(0, sigma_m, len(rays))
    points: FloatArray = ranges[:, None] * rays
    return points


def test_E15_lines_of_a_room_are_as_exact_as_they_say() -> None:
    """Over 60 scans, errors of place and direction have the deviations that the lines claim."""
    config = LineConfig(least_sigma_m=1e-6, least_sigma_rad=1e-6)
    off, turned = [], []
    for seed in range(60):
        lines = find_lines(room(np.random.default_rng(seed)), config)
        long = np.flatnonzero(np.ptp(lines.ends_m, axis=1) > 2.5)
        normals = np.stack([-lines.directions[:, 1], lines.directions[:, 0]], axis=1)
        for row in long:
            true = -np.round(normals[row])
            distance = {(1, 0): 4, (-1, 0): 2, (0, 1): 3, (0, -1): 1}[tuple(true.astype(int))]
            off.append((lines.middles[row] @ true - distance) / lines.sigmas_m[row])
            sine = normals[row] @ [-true[1], true[0]]
            turned.append(np.arcsin(sine) / lines.sigmas_rad[row])
        assert len(long) >= 3

    assert np.std(off) == pytest.approx(1.0, abs=0.3)
    assert np.std(turned) == pytest.approx(1.0, abs=0.3)


def test_a_point_alone_does_not_split_a_line() -> None:
    y = np.linspace(-2, 2, 100)
    points = np.stack([np.full(100, 3.0), y], axis=1)
    points[40, 0] -= 0.14

    lines = find_lines(points, LineConfig())

    assert len(lines) == 1
    assert lines.num_points.tolist() == [100]
    np.testing.assert_allclose(lines.directions[0], [0, 1], atol=0.01)  # the laser is to its left


def test_nothing_is_found_in_nothing() -> None:
    assert len(find_lines(np.empty((0, 2)), LineConfig())) == 0
    cloud = np.random.default_rng(0).uniform(-5, 5, (200, 2))
    assert len(find_lines(cloud, LineConfig())) == 0


@pytest.fixture(scope="module")
def drive() -> tuple[list[LaserScan2D], list[Odometry]]:
    records = list(islice(w_2d(W2dConfig.model_validate(SMALL), 0).records, 1200))
    scans = [r.message for r in records if isinstance(r.message, LaserScan2D)]
    return scans[40:], [r.message for r in records if isinstance(r.message, Odometry)]


@pytest.mark.anyio
async def test_E15_walls_are_planes_on_the_walls(
    drive: tuple[list[LaserScan2D], list[Odometry]],
) -> None:
    """Right before each line the floor is free, right behind it is a wall; and most of what was seen is on one."""
    scans, odometry = drive
    floor = w_2d_floor(W2dConfig.model_validate(SMALL), 0)
    way = Trajectory(
        stamps_ns=np.array([m.stamp_ns for m in odometry]),
        poses=np.array([m.T_odom_base.matrix for m in odometry]),
    )
    out = await run_operator(LaserLines(LaserLinesConfig()), laser=scans, odometry=odometry)
    found: list[PlaneSegments] = out["planes"]

    assert len(found) == pytest.approx(len(scans) / 5, abs=1)
    shares = []
    for segments in found:
        T_world_plane = way.at(segments.stamp_ns)[0] @ segments.T_base_plane
        for T, hull in zip(T_world_plane, segments.hulls_m, strict=True):
            assert T[2, 1] == pytest.approx(-1.0, abs=1e-9)  # y is vertical
            along = np.linspace(hull[0, 0] + 0.05, hull[1, 0] - 0.05, 20)
            line = T[:2, 3] + along[:, None] * T[:2, 0]
            free = ~floor.is_solid(line + 0.03 * T[:2, 2])
            solid = floor.is_solid(line - 0.03 * T[:2, 2])
            shares.append((free & solid).mean())
    num_hits = sum(np.isfinite(scan.ranges_m).sum() for scan in scans) / len(scans)
    num_on_lines = np.mean([segments.num_points.sum() for segments in found])

    assert np.mean(np.array(shares) > 0.9) > 0.95
    assert num_on_lines > 0.6 * num_hits


def test_E15_a_wall_seen_while_turning_needs_the_motion(
    drive: tuple[list[LaserScan2D], list[Odometry]],
) -> None:
    """A wall's direction is wrong by the turn during the sweep, unless the odometry is known."""
    scans, odometry = drive
    operator = LaserLines(LaserLinesConfig())
    way = {m.stamp_ns: m.T_odom_base for m in odometry}
    turn = max(
        scans[10:-10],
        key=lambda s: abs((way[s.stamp_ns].inverse() @ way[s.stamp_ns + 80_000_000]).angle_rad),
    )
    moved, standing = operator.find(turn, odometry), operator.find(turn)
    T_world_base = Trajectory(
        stamps_ns=np.array(list(way)), poses=np.array([T.matrix for T in way.values()])
    ).at(moved.stamp_ns)

    def off_axis(found: PlaneSegments) -> float:
        """Return the median angle to the building's axes [rad]; furniture may stand askew."""
        x = (T_world_base @ found.T_base_plane)[:, :2, 0]
        angle = np.arctan2(x[:, 1], x[:, 0])
        return float(np.median(np.abs((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)))

    assert off_axis(moved) < 0.008
    assert off_axis(standing) > 2 * off_axis(moved)
