"""A real robot outdoors: wheels, an IMU and satellite fixes, alone and together, in one graph."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.operators.backend.live_map import LiveMap
from mapstream.operators.estimation.batch import OptimizeConfig
from mapstream.operators.gnss.positions import Gnss, GnssConfig
from mapstream.operators.sources.mcap import McapSource
from mapstream.operators.sources.mcap_config import McapSourceConfig
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.operators.trajectory.trajectory import Trajectory
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.messages.constraints import Constraint
from tests.data import shared

pytestmark = [pytest.mark.anyio, pytest.mark.slow]

# Where the IMU sits; of the four turns about its upright axis this one leaves a fifth of the next best error
# when it is combined with the wheels.
RIG = Path(__file__).parents[3] / "examples" / "06_wheels_imu_gnss" / "husky.yaml"
GROUND = {"kind": "still", "sigma_roll_rad": 0.02, "sigma_pitch_rad": 0.02, "sigma_z_m": 0.05}


async def recorded() -> dict[str, list[Any]]:
    path = shared("husky") / "husky_imu_odom_gps.mcap"
    topics = {
        "wheels": {"topic": "/husky_velocity_controller/odom", "type": "WheelOdometry"},
        "imu": "/imu/data",
        "fixes": "/fix",
    }
    config = McapSourceConfig.model_validate({"path": path, "topics": topics, "rig": RIG})
    sent = await run_operator(McapSource(config), config=config)
    sent["fixes"] = (await run_operator(Gnss(GnssConfig()), fixes=sent["fixes"]))["constraints"]
    return sent


async def solved(messages: dict[str, list[Any]], *ports: str) -> Map:
    """Return the map of these inputs, with a pose every second or at one fix in a second."""
    config = TrajectoryConfig.model_validate(
        {
            "sources": {"wheels": {"kind": "wheel"}, "ground": GROUND},
            "imu": {"rig": RIG} if "imu" in ports else None,
            "constraints": {"fixes": {"period_s": 1.0}} if "fixes" in ports else {},
            "period_s": 10.0 if "fixes" in ports else 1.0,
            "submap_s": 30.0,
        }
    )
    inputs: dict[str, Any] = {port: messages[port] for port in ports}
    submaps = (await run_operator(Trajectory(config), config=config, **inputs))["submaps"]
    live = LiveMap(OptimizeConfig(underconstrained="prior"))
    for submap in submaps:
        live.append(submap)
    live.finish()
    return live.map


def residual_m(map_: Map, fixes: list[Constraint]) -> float:
    """Return the rms distance on the ground to all fixes, after the best turn and shift."""
    path = map_.trajectory(map_.mission_id(0))
    within = [f for f in fixes if path.covers(f.stamp_ns)]
    found = path.at([f.stamp_ns for f in within])[:, :2, 3]
    truth = np.array([f.T_a_b.t[:2] for f in within])
    return float(np.sqrt((_distances(found, truth) ** 2).mean()))


def _distances(a: FloatArray, b: FloatArray) -> FloatArray:
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, np.linalg.det(U @ Vt)]) @ Vt
    distances: FloatArray = np.linalg.norm(b - a @ R.T, axis=1)
    return distances


async def test_A8_each_sensor_of_a_real_robot_lowers_the_distance_to_its_satellite_fixes() -> None:
    messages = await recorded()

    wheels = await solved(messages, "wheels")
    inertial = await solved(messages, "wheels", "imu")
    everything = await solved(messages, "wheels", "imu", "fixes")

    residuals = [residual_m(map_, messages["fixes"]) for map_ in (wheels, inertial, everything)]
    assert residuals[0] > residuals[1] > residuals[2], residuals
    for map_ in (wheels, inertial, everything):
        assert check_map(map_) == []
    assert everything.edges.kind.tolist().count("wheel") == len(everything.vertices) - 1
    assert np.abs(everything.vertices.gyro_bias_radps).max() < 0.01
    assert np.abs(everything.vertices.accel_bias_mps2).max() < 0.5
