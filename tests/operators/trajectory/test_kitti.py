"""A real car, KITTI 00: an IMU, and positions of which few are used or many are false."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.operators.backend.live_map import LiveMap
from mapstream.operators.estimation.batch import OptimizeConfig
from mapstream.operators.sources.mcap import McapSource
from mapstream.operators.sources.mcap_config import McapSourceConfig
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.operators.trajectory.trajectory import Trajectory
from mapstream.recordings.datasets.catalogue import convert
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint

pytestmark = [pytest.mark.anyio, pytest.mark.slow]

NOISE = {
    "gyro_density": 0.002,
    "accel_density": 0.1,
    "gyro_random_walk": 1e-5,
    "accel_random_walk": 1e-4,
}
SIGMA_M = 1.0  # of a satellite receiver without corrections
SHIFT_M = 20.0
SECONDS = 120.0


async def recorded(folder: Path, end_s: float | None = None) -> dict[str, list[Any]]:
    path = folder / "kitti.mcap"
    convert("kitti00-gtsam", path)
    positions = {"topic": "/gps", "type": "Constraint"}
    options = {"path": path, "topics": {"imu": "/imu", "positions": positions}, "end_s": end_s}
    config = McapSourceConfig.model_validate(options)
    return await run_operator(McapSource(config), config=config)


async def solved(
    imu: list[Any], positions: list[Constraint], *, period_s: float, rejects: bool
) -> Map:
    """Return the map as the graph `gnss_inertial` makes it."""
    config = TrajectoryConfig.model_validate(
        {
            "imu": NOISE,
            "constraints": {"positions": {"period_s": period_s}},
            "submap_s": 10.0,
        }
    )
    sent = await run_operator(Trajectory(config), config=config, imu=imu, positions=positions)
    live = LiveMap(OptimizeConfig(underconstrained="prior", reject_absolute=rejects))
    for submap in sent["submaps"]:
        live.append(submap)
    live.finish()
    return live.map


def distances_m(map_: Map, positions: list[Constraint]) -> FloatArray:
    """Return how far (N,) the map is from positions within it, in the frame that it found for them."""
    path = map_.trajectory(map_.mission_id(0))
    within = [position for position in positions if path.covers(position.stamp_ns)]
    found = (map_.missions.T_map_mission[0] @ path.at([p.stamp_ns for p in within]))[:, :3, 3]
    measured = np.array([(map_.frames.T_map_frame[0] @ p.T_a_b.matrix)[:3, 3] for p in within])
    distances: FloatArray = np.linalg.norm(found - measured, axis=1)
    return distances


def rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


async def test_A9_a_position_every_ten_seconds_leads_an_IMU_within_a_metre(tmp_path: Path) -> None:
    sent = await recorded(tmp_path)

    map_ = await solved(sent["imu"], sent["positions"], period_s=10.0, rejects=False)

    rows = map_.edges.vertex_a[map_.edges_of("position")]
    taken = set(map_.vertices.stamp_ns[rows].tolist())
    unused = [p for p in sent["positions"] if p.stamp_ns not in taken]
    assert len(unused) > 400
    assert rms(distances_m(map_, unused)) < 0.85  # 0.70 when this was written
    speed_mps = np.linalg.norm(map_.vertices.velocity_mps, axis=1)
    assert 10.0 < speed_mps.max() < 16.0, "a car in a town"
    assert np.abs(map_.vertices.gyro_bias_radps).max() < 0.005
    assert np.abs(map_.vertices.accel_bias_mps2).max() < 0.2


def shifted(positions: list[Constraint], seed: int) -> tuple[list[Constraint], set[int]]:
    """Return positions of which three in ten are false, by some way in any direction, and the stamps of those."""
    rng = np.random.default_rng(seed)
    chosen = set(rng.choice(len(positions), round(0.3 * len(positions)), replace=False).tolist())
    result = list(positions)
    for row in chosen:
        angle = rng.uniform(0, 2 * np.pi)
        shift = SHIFT_M * np.array([np.cos(angle), np.sin(angle), 0.0])
        T_a_b = SE3.from_rotation(np.eye(3), positions[row].T_a_b.t + shift)
        result[row] = replace(positions[row], T_a_b=T_a_b)
    return result, {positions[row].stamp_ns for row in chosen}


async def test_K9_three_false_positions_in_ten_are_found_where_only_an_IMU_speaks_against_them(
    tmp_path: Path,
) -> None:
    sent = await recorded(tmp_path, SECONDS)
    covariance = np.diag([np.inf] * 3 + [SIGMA_M**2] * 3)
    positions = [replace(position, covariance=covariance) for position in sent["positions"]]
    lying, false_ns = shifted(positions, seed=1)

    map_ = await solved(sent["imu"], lying, period_s=0.0, rejects=True)
    clean = await solved(sent["imu"], positions, period_s=0.0, rejects=True)

    rows = map_.edges_of("position")
    stamps_ns = map_.vertices.stamp_ns[map_.edges.vertex_a[rows]]
    left_out = set(stamps_ns[map_.edges.switch[rows] < 0.5].tolist())
    assert left_out == false_ns, "all that are false, and no others"
    assert (clean.edges.switch[clean.edges_of("position")] == 1).all()
    error_m = [rms(distances_m(each, positions)) for each in (map_, clean)]
    assert error_m[0] < 0.45, error_m
