"""The floor plan of a map: while it grows, of the finished one, and what robots are found by."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest

from mapstream.operators.laser.beams import beam_ends
from mapstream.operators.laser.floor import open_floor
from mapstream.operators.laser.map_grid import GridConfig, map_grid
from mapstream.operators.laser.occupancy_grid import OccupancyGrids
from mapstream.operators.sinks.grid import GridSink, GridSinkConfig
from mapstream.operators.sinks.map_store import MapStore, MapStoreConfig
from mapstream.operators.submaps.keyframes import Keyframes, KeyframesConfig
from mapstream.operators.submaps.submap_builder import SubmapBuilder, SubmapBuilderConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.grid_files import read_grid
from mapstream.recordings.maps import Map, load_map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.worlds.w_2d import T_BASE_LASER, W2dConfig, w_2d, w_2d_floor
from mapstream.streams.errors import MapError
from mapstream.streams.messages.estimates import Odometry, PointCloud, Submap
from mapstream.streams.messages.grids import OccupancyGrid
from mapstream.streams.messages.sensors import LaserScan2D
from mapstream.streams.trajectory import Trajectory

pytestmark = pytest.mark.anyio
SMALL: dict[str, Any] = {
    "width_m": 14.0,
    "laps": 0.2,
    "visits": False,
    "wheels_hz": 1.0,
    "laser": {"beams": 181, "rate_hz": 3.0},
}
CONFIG = {"sensor_xyz_m": tuple(T_BASE_LASER.t.tolist())}


@dataclass
class Drive:
    """A map at the true poses."""

    submaps: list[Submap]
    maps: list[Map]


@pytest.fixture(scope="module")
def drive() -> Drive:
    return anyio.run(driven)


async def driven() -> Drive:
    messages = [record.message for record in w_2d(W2dConfig.model_validate(SMALL), 0).records]
    truth = {m.stamp_ns: m.T_odom_base.matrix for m in messages if isinstance(m, Odometry)}
    way = Trajectory(stamps_ns=np.array(list(truth)), poses=np.array(list(truth.values())))
    scans = [m for m in messages if isinstance(m, LaserScan2D) and way.covers(m.end_ns)]
    odometry = [Odometry(stamp_ns=m.end_ns, T_odom_base=way.pose_at(m.end_ns)) for m in scans]
    clouds = [
        PointCloud(stamp_ns=m.end_ns, points=beam_ends(m, way).points.astype(np.float32))
        for m in scans
    ]
    chosen = Keyframes(KeyframesConfig(distance_m=0.4))
    keyframes = await run_operator(chosen, odometry=odometry, clouds=clouds)
    builder = SubmapBuilder(SubmapBuilderConfig(length_m=4.0))
    submaps = (await run_operator(builder, keyframes=keyframes["keyframes"]))["submaps"]
    maps = [Map.empty()]
    for submap in submaps:
        maps.append(append_submap(maps[-1], submap))
    return Drive(submaps, maps[1:])


def right_share(grid: OccupancyGrid) -> float:
    """Return the share of the cells that are said to be free, and are."""
    floor = w_2d_floor(W2dConfig.model_validate(SMALL), 0)
    rows, columns = np.nonzero((grid.cells >= 0) & (grid.cells < 20))
    middles = np.stack([columns + 0.5, rows + 0.5, 0 * rows], axis=1) * grid.resolution_m
    return float((~floor.is_solid((grid.T_map_grid @ middles)[:, :2])).mean())


async def test_N11_a_map_that_grows_has_a_grid(drive: Drive, tmp_path: Path) -> None:
    """The last of its grids is that of the file, and what it calls free is free."""
    path = tmp_path / "plan.yaml"
    operator = OccupancyGrids(GridConfig.model_validate(CONFIG))

    out = await run_operator(operator, maps=drive.maps[-1:], submaps=drive.submaps)
    await run_operator(GridSink(GridSinkConfig(path=path)), grids=out["grids"])

    (grid,) = out["grids"]
    assert right_share(grid) > 0.995
    free_m2 = ((grid.cells >= 0) & (grid.cells < 20)).sum() * grid.resolution_m**2
    assert free_m2 > 30
    found = read_grid(path)
    np.testing.assert_array_equal(found.cells == 100, grid.cells >= 65)
    np.testing.assert_allclose(found.T_map_grid.t, grid.T_map_grid.t, atol=1e-9)


async def test_N11_N12_a_stored_map_has_the_same_grid_and_is_a_floor(
    drive: Drive, tmp_path: Path
) -> None:
    folder = tmp_path / "map"
    store = MapStore(MapStoreConfig(path=folder))
    await run_operator(store, maps=drive.maps[-1:], submaps=drive.submaps)
    map_ = load_map(folder)

    grid, report = map_grid(map_, folder, GridConfig.model_validate(CONFIG))
    guessed = map_grid(map_, folder)[1]
    surface = open_floor(folder).surface

    assert right_share(grid) > 0.995
    assert report.num_clouds == len(map_.vertices)
    assert report.knows_sensors
    assert "beams were taken to begin at the base" in guessed.lines()[0]
    floor = w_2d_floor(W2dConfig.model_validate(SMALL), 0)
    is_lined = np.isfinite(surface.normals[:, 0])
    before = surface.points[is_lined] + 0.04 * surface.normals[is_lined]
    assert (~floor.is_solid(before)).mean() > 0.97


async def test_a_map_without_clouds_has_no_grid(drive: Drive, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="there are no clouds at all"):
        map_grid(drive.maps[0], tmp_path)
