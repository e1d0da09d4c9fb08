"""Grids of odds: what beams pass is free, where they end it is not, and nothing else is known."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.operators.laser.beams import beam_ends
from mapstream.operators.laser.odds_grid import OddsConfig, OddsGrid, Rays
from mapstream.operators.laser.sight import rays_of
from mapstream.recordings.worlds.office import Office
from mapstream.recordings.worlds.w_2d import W2dConfig, w_2d, w_2d_floor
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.grids import OccupancyGrid
from mapstream.streams.messages.sensors import LaserScan2D
from mapstream.streams.trajectory import Trajectory


def ray(start: tuple[float, float], end: tuple[float, float]) -> Rays:
    return Rays(np.array([end]), np.array([[start, end]]))


def at(grid: OccupancyGrid, x: float, y: float) -> int:
    """Return the cell at a point of the map."""
    column, row, _ = np.floor((grid.T_map_grid.inverse() @ np.array([x, y, 0.0])) / 0.1)
    return int(grid.cells[int(row), int(column)])


def test_a_beam_clears_its_way_and_fills_its_end() -> None:
    odds = OddsGrid(OddsConfig(resolution_m=0.1))
    for _ in range(5):
        odds.add(ray((-0.55, 0.05), (1.05, 0.05)))
    odds.add(ray((-0.55, 0.35), (0.35, 0.35)))

    grid = odds.grid(3)

    assert grid.cells.shape == (4, 17)
    assert grid.stamp_ns == 3
    assert [at(grid, x, 0.05) < 15 for x in np.arange(-0.55, 0.9, 0.1)] == [True] * 15
    assert at(grid, 1.05, 0.05) == 98
    assert at(grid, 0.35, 0.35) == 85
    assert at(grid, 0.35, 0.15) == -1


def test_a_scan_counts_a_cell_once_and_hits_win() -> None:
    """Two beams of one scan: the second passes the cell in which the first ended."""
    odds = OddsGrid(OddsConfig(resolution_m=0.1))
    ends = np.array([[0.55, 0.05], [0.95, 0.05]])
    odds.add(Rays(ends, np.stack([np.zeros((2, 2)) + 0.05, ends], axis=1)))

    grid = odds.grid(0)

    assert at(grid, 0.55, 0.05) == 85
    assert at(grid, 0.25, 0.05) == 20


def test_what_moved_away_is_cleared() -> None:
    odds = OddsGrid(OddsConfig(resolution_m=0.1))
    for _ in range(30):
        odds.add(ray((0.05, 0.05), (0.55, 0.05)))
    for _ in range(30):
        odds.add(ray((0.05, 0.05), (0.95, 0.05)))

    assert at(odds.grid(0), 0.55, 0.05) < 10


def test_a_grid_that_grows_too_far_is_refused() -> None:
    odds = OddsGrid(OddsConfig(resolution_m=0.1, max_cells=10_000))
    with pytest.raises(MapError, match="use larger cells"):
        odds.add(ray((0.0, 0.0), (500.0, 500.0)))
    with pytest.raises(MapError, match="no beam reached any cell"):
        OddsGrid(OddsConfig()).grid(0)


def test_N11_beams_over_and_under_what_stands_in_the_way_do_not_clear_it() -> None:
    """Of a sensor at 1.2 m: the wall is hit, the floor is free where the beam is low, the ceiling says nothing."""
    ends = np.array([[4.0, 0, 0.8], [6.0, 0, 0.0], [0.0, 5.0, 2.5]])

    rays = rays_of(ends, np.array([0, 0, 1.2]), np.eye(4), (0.2, 0.6), 20.0)
    walls = rays_of(ends, np.array([0, 0, 1.2]), np.eye(4), (0.2, 1.0), 20.0)

    assert len(rays.hits) == 0
    np.testing.assert_allclose(rays.passed, [[[3.0, 0], [5.0, 0]]])
    np.testing.assert_allclose(walls.hits, [[4.0, 0]])
    expected = np.array([[[2.0, 0], [4.0, 0]], [[1.0, 0], [5.0, 0]]])
    np.testing.assert_allclose(walls.passed, expected)


def test_beams_of_a_planar_laser_count_at_any_height_up_to_the_range() -> None:
    T = SE3.from_rotation(so3_exp([0, 0, np.pi / 2]), [1.0, 0, 0]).matrix
    ends = np.array([[2.0, 0, 5.0], [30.0, 0, 5.0]])

    rays = rays_of(ends, np.array([0.5, 0, 5.0]), T, (0.1, 1.0), 10.0)

    np.testing.assert_allclose(rays.hits, [[1.0, 2.0]], atol=1e-9)
    expected = np.array([[[1, 0.5], [1, 2]], [[1, 0.5], [1, 10.5]]])
    np.testing.assert_allclose(rays.passed, expected, atol=1e-9)


def overlap(a: BoolArray, b: BoolArray) -> float:
    return float((a & b).sum() / (a | b).sum())


def free_plan(floor: Office, grid: OccupancyGrid, T_world_map: FloatArray) -> BoolArray:
    """Return which cells of a grid are free in truth."""
    rows, columns = grid.cells.shape
    x, y = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    points = np.stack([x * grid.resolution_m, y * grid.resolution_m, 0 * x, 0 * x + 1], axis=-1)
    in_world = (points @ (T_world_map @ grid.T_map_grid.matrix).T)[..., :2]
    return floor.is_inside(in_world) & ~floor.is_solid(in_world)


@pytest.mark.slow
def test_N11_the_grid_of_true_poses_is_the_plan() -> None:
    """A lap through all rooms: overlap (IoU) of what is free, shadows of furniture included, is 0.9 or more."""
    config = W2dConfig.model_validate(
        {"width_m": 14, "laps": 1, "wheels_hz": 1.0, "laser": {"beams": 271, "rate_hz": 3.0}}
    )
    messages = [record.message for record in w_2d(config, 0).records]
    truth = [m for m in messages if isinstance(m, Odometry)]
    way = Trajectory(
        stamps_ns=np.array([m.stamp_ns for m in truth]),
        poses=np.array([m.T_odom_base.matrix for m in truth]),
    )
    odds = OddsGrid(OddsConfig())
    for scan in messages:
        if isinstance(scan, LaserScan2D) and way.covers(scan.end_ns):
            T = way.pose_at(scan.end_ns).matrix
            points = beam_ends(scan, way).points
            odds.add(rays_of(points, scan.T_base_sensor.t, T, (0.1, 1.5), 20.0))

    grid = odds.grid(0)

    free = (grid.cells >= 0) & (grid.cells < 20)
    plan = free_plan(w_2d_floor(config, 0), grid, np.eye(4))
    assert (free & plan).sum() / free.sum() > 0.995
    assert overlap(free, plan) >= 0.9
