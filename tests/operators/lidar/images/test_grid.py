"""Scans on a grid of beams and columns: every point that is shown is the one that was measured there."""

from itertools import pairwise

import numpy as np
import pytest

from mapstream.operators.lidar.images.grid import Columns, GridConfig, ScanGrid
from mapstream.operators.operator import Context, set_context
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.sensors import LidarScan
from tests.data import shared
from tests.operators.scenes import scan_at

_ELEVATIONS = np.deg2rad(np.linspace(20, -20, 64))  # ring 0 looks up, as an Ouster's does


def points_of(yaw_rad: FloatArray, elevation_rad: FloatArray, range_m: FloatArray) -> FloatArray:
    flat = np.cos(elevation_rad)
    directions = [np.cos(yaw_rad) * flat, np.sin(yaw_rad) * flat, np.sin(elevation_rad)]
    points: FloatArray = range_m[..., None] * np.stack(directions, axis=-1)
    return points


def staggered(columns: int = 2048, seed: int = 0) -> LidarScan:
    """A scan whose beams fire at yaws of their own, each shifted by another part of a column and some columns."""
    rng = np.random.default_rng(seed)
    shifts = np.random.default_rng(7).uniform(-9, 9, 64)
    fired = np.arange(columns)[:, None] + shifts + rng.normal(0, 0.04, (columns, 64))
    yaw = np.pi - fired * 2 * np.pi / columns
    elevation = np.broadcast_to(_ELEVATIONS, yaw.shape)
    points = points_of(yaw, elevation, rng.uniform(2, 20, yaw.shape)).reshape(-1, 3)
    ring = np.tile(np.arange(64, dtype=np.uint16), columns)
    return scan_at(points, seed, ring=ring)


def test_D16_staggered_beams_fill_every_pixel_of_64_x_2048_once() -> None:
    """One scan tells where each beam's points usually lie in a column."""
    grid = ScanGrid(GridConfig())

    for seed in (0, 1):
        projected = grid.project(staggered(seed=seed))

        assert projected.point.shape == (64, 2048)
        assert projected.is_measured.all()
        assert len(np.unique(projected.point)) == 64 * 2048


def test_D16_without_the_learnt_table_neighbours_share_pixels() -> None:
    """A beam that fires where two columns meet."""
    fired = np.arange(2048) + 0.5 + np.random.default_rng(0).normal(0, 0.04, 2048)
    beams, yaw = np.zeros(2048, np.int64), np.pi - (fired + 0.5) * 2 * np.pi / 2048
    columns = Columns(2048, 1)
    before = columns.of(beams, yaw)

    columns.learn(beams, yaw)

    assert len(np.unique(before)) < 0.9 * 2048
    assert len(np.unique(columns.of(beams, yaw))) == 2048


def test_D16_each_pixel_shows_the_point_that_lies_there() -> None:
    scan = staggered()
    projected = ScanGrid(GridConfig()).project(scan)
    row, column = np.nonzero(projected.is_measured)
    points = scan.points[projected.point[row, column]].astype(np.float64)

    np.testing.assert_allclose(
        projected.range_m[row, column], np.linalg.norm(points, axis=1), rtol=1e-6
    )
    assert scan.ring is not None
    np.testing.assert_array_equal(scan.ring[projected.point[row, column]], row)
    middle = np.pi - (column + 0.5) * 2 * np.pi / 2048
    away = np.arctan2(points[:, 1], points[:, 0]) - middle
    assert np.abs(np.mod(away + np.pi, 2 * np.pi) - np.pi).max() < 1.01 * 2 * np.pi / 2048


def test_of_two_points_in_a_pixel_the_nearer_is_seen_and_what_is_no_return_is_not() -> None:
    points = np.array([[5, 0, 0], [3, 0, 0], [0, 0, 0], [-4, 0.01, 0]], np.float64)
    ring = np.full(4, 15, np.uint16)

    projected = ScanGrid(GridConfig(columns=512)).project(scan_at(points, 0, ring=ring))

    assert projected.point.shape == (16, 512)
    assert sorted(projected.point[projected.is_measured].tolist()) == [1, 3]


@pytest.mark.parametrize(("beams", "columns"), [(64, 1024), (64, 2048), (32, 512), (16, 1800)])
def test_D16_the_size_is_what_the_lidar_has(beams: int, columns: int) -> None:
    yaw, beam = np.meshgrid(np.linspace(-np.pi, np.pi, columns, endpoint=False), np.arange(beams))
    elevation = np.deg2rad(-15 + 30 * beam / beams)  # ring 0 looks down, as a Velodyne's does
    points = points_of(yaw, elevation, np.full(yaw.shape, 5.0))
    ring = beam.ravel().astype(np.uint16)

    projected = ScanGrid(GridConfig()).project(scan_at(points.reshape(-1, 3), 0, ring=ring))

    assert projected.point.shape == (beams, 2048 if columns == 1800 else columns)
    assert ring[projected.point[0].max()] == beams - 1


def test_D16_kitti_has_no_rings_and_the_order_of_its_points_tells_the_beams() -> None:
    """HDL-64: 64 rows, each with the elevations of one beam; nearly all points are seen."""
    path = shared("kitti00_lidar") / "000000.bin"
    points = np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]

    projected = ScanGrid(GridConfig()).project(scan_at(points, 0))

    assert projected.point.shape == (64, 2048)
    assert projected.is_measured.sum() > 0.85 * len(points)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    medians = [np.median(elevation[row[row >= 0]]) for row in projected.point]
    assert (np.diff(medians) < 0).all()


def test_points_without_order_lie_in_rows_of_equal_elevation() -> None:
    rng = np.random.default_rng(0)
    yaw, elevation = rng.uniform(-0.7, 0.7, 20_000), rng.uniform(-0.6, 0.6, 20_000)
    scan = scan_at(points_of(yaw, elevation, np.full(20_000, 4.0)), 0)

    projected = ScanGrid(GridConfig(columns=256)).project(scan)

    assert projected.point.shape == (64, 256)
    rows = [elevation[row[row >= 0]] for row in projected.point]
    assert all(np.ptp(row) < 1.5 * 1.2 / 64 for row in rows[1:-1])
    assert all(a.mean() > b.mean() for a, b in pairwise(rows))


def test_an_image_with_fewer_rows_than_beams_is_refused_by_name() -> None:
    with pytest.raises(OperatorError, match="64 beams, told by their ring; an image of 32 rows"):
        ScanGrid(GridConfig(rows=32)).project(staggered())


def test_beams_that_come_later_are_told() -> None:
    context = Context()
    set_context(context)
    grid = ScanGrid(GridConfig())
    points = np.tile([[5.0, 0, 0]], (20, 1))
    grid.project(scan_at(points, 0, ring=np.arange(16, dtype=np.uint16).repeat(2)[:20]))

    grid.project(scan_at(points, 1, ring=np.full(20, 40, np.uint16)))

    assert any(
        "beams that its first scan did not have" in text for text in context.activity.warnings
    )


def test_an_empty_scan_makes_an_empty_grid() -> None:
    projected = ScanGrid(GridConfig()).project(scan_at(np.empty((0, 3)), 0))

    assert not projected.is_measured.any()
