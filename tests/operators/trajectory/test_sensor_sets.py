"""What several sensors say together: wheels that slip, robots with different sensors, odometry from a file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.operators.backend.live_map import LiveMap
from mapstream.operators.estimation.batch import OptimizeConfig
from mapstream.operators.sources.odometry_file import OdometryFile, OdometryFileConfig
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import TrajectoryConfig
from mapstream.operators.trajectory.trajectory import Trajectory
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.store import load_map, save_map
from mapstream.streams.geometry import SE3, invert
from mapstream.streams.messages.estimates import Odometry, Submap
from mapstream.streams.messages.sensors import WheelOdometry
from tests.operators.trajectory.drives import MS, TWIST, fix, imu, odometry, pose_at, wheels

pytestmark = pytest.mark.anyio

SECOND = 1_000 * MS
STAMPS = range(0, 10_001 * MS, 100 * MS)
LIDAR = {"kind": "odometry"}
WHEELS = {"kind": "wheel"}


async def submaps_of(config: dict[str, Any], **inputs: Any) -> list[Submap]:  # noqa: ANN401  # lists of messages
    checked = TrajectoryConfig.model_validate(config)
    sent = await run_operator(Trajectory(checked), config=checked, **inputs)
    submaps: list[Submap] = sent["submaps"]
    return submaps


def solved(*missions: list[Submap]) -> Map:
    live = LiveMap(OptimizeConfig(underconstrained="prior"))
    for submap in (each for mission in missions for each in mission):
        live.append(submap)
    live.finish()
    return live.map


def error_m(map_: Map) -> float:
    """Return the farthest that a pose is from the truth, both seen from the first pose."""
    poses = map_.vertices.T_mission_base
    truth = np.array([pose_at(int(stamp_ns)).matrix for stamp_ns in map_.vertices.stamp_ns])
    return float(np.linalg.norm((invert(poses[0]) @ poses - truth)[:, :3, 3], axis=1).max())


def slipping() -> list[WheelOdometry]:
    """Return wheels that count a tenth too much from 4 s to 6 s."""
    T_odom_base, messages = SE3.identity(), []
    for stamp_ns in STAMPS:
        messages.append(WheelOdometry(stamp_ns=stamp_ns, T_odom_base=T_odom_base))
        slip = 1.1 if 4 * SECOND <= stamp_ns < 6 * SECOND else 1.0
        T_odom_base = T_odom_base @ SE3.exp(TWIST * [1, 1, 1, slip, 1, 1] * 0.1)
    return messages


def scan_matched(rng: np.random.Generator) -> list[Odometry]:
    """Return LiDAR odometry whose steps are off by 1 mm and 0.2 mrad."""
    sigmas = np.array([2e-4] * 3 + [1e-3] * 3)
    T_odom_base, messages = SE3.identity(), []
    for stamp_ns in STAMPS:
        covariance = np.diag(sigmas**2)
        messages.append(Odometry(stamp_ns=stamp_ns, T_odom_base=T_odom_base, covariance=covariance))
        T_odom_base = T_odom_base @ SE3.exp(TWIST * 0.1 + rng.normal(size=6) * sigmas)
    return messages


async def test_U10_beside_lidar_two_seconds_of_slipping_wheels_cost_less_than_five_centimetres() -> (
    None
):
    lidar = scan_matched(np.random.default_rng(10))
    both = {"sources": {"wheels": WHEELS, "lidar": LIDAR}}
    ground = {"kind": "still", "sigma_roll_rad": 0.02, "sigma_pitch_rad": 0.02, "sigma_z_m": 0.05}
    alone = {"sources": {"wheels": WHEELS, "ground": ground}}

    together = solved(await submaps_of(both, wheels=slipping(), lidar=lidar))
    drifted = solved(await submaps_of({"sources": {"lidar": LIDAR}}, lidar=lidar))
    slipped = solved(await submaps_of(alone, wheels=slipping()))

    assert error_m(together) < 0.05
    assert error_m(together) < error_m(drifted) + 0.01
    assert error_m(slipped) > 0.15


async def test_A16_missions_of_different_sensors_live_in_one_map_and_keep_their_sets(
    tmp_path: Path,
) -> None:
    batches = [imu(s) for s in range(40 * MS, 10_001 * MS, 50 * MS)]
    inertial = await submaps_of(
        {"sources": {"odometry": LIDAR}, "imu": {"gyro_density": 2e-3}, "mission": "inertial"},
        odometry=[odometry(s) for s in STAMPS], imu=batches,
    )  # fmt: skip
    rolling = await submaps_of(
        {"sources": {"lidar": LIDAR, "wheels": WHEELS}, "mission": "rolling"},
        lidar=[odometry(s) for s in STAMPS], wheels=[wheels(s) for s in STAMPS],
    )  # fmt: skip
    positions = await submaps_of(
        {"constraints": {"fixes": {}}, "mission": "positions"},
        fixes=[fix(s) for s in range(0, 10_001 * MS, SECOND)],
    )
    map_ = solved(inertial, rolling, positions)

    save_map(map_, tmp_path / "map")
    loaded = load_map(tmp_path / "map")

    assert check_map(loaded) == []
    assert loaded.digest() == map_.digest()
    kinds = {}
    for mission, submaps in (
        ("inertial", inertial),
        ("rolling", rolling),
        ("positions", positions),
    ):
        row = loaded.mission_row(submaps[0].mission_id)
        edges = loaded.edges.kind[loaded.vertices.mission[loaded.edges.vertex_a] == row]
        sensors = json.loads(str(loaded.missions.sensors[row]))
        kinds[mission] = set(edges.tolist()), set(sensors) - {"sources"}, set(sensors["sources"])
    assert kinds == {
        "inertial": ({"odometry", "imu"}, {"imu"}, {"odometry"}),
        "rolling": ({"odometry", "wheel"}, set(), {"lidar", "wheels"}),
        "positions": ({"position", "motion_model"}, set(), set()),
    }
    row = loaded.mission_row(inertial[0].mission_id)
    assert json.loads(str(loaded.missions.sensors[row]))["imu"]["gyro_density"] == 2e-3


async def test_A9_odometry_of_a_file_makes_a_map_without_an_imu(tmp_path: Path) -> None:
    file = tmp_path / "path.tum"
    poses = [(s, pose_at(s)) for s in STAMPS]
    rows = [np.r_[s / 1e9, pose.t, pose.quat_xyzw] for s, pose in poses]
    file.write_text("\n".join(" ".join(f"{value:.12g}" for value in row) for row in rows))
    played = OdometryFileConfig(path=file)
    messages = (await run_operator(OdometryFile(played), config=played))["odometry"]

    map_ = solved(await submaps_of({"sources": {"file": LIDAR}}, file=messages))

    assert set(map_.edges.kind.tolist()) == {"odometry"}
    assert map_.vertices.stamp_ns.tolist() == list(range(0, 10 * SECOND + 1, SECOND))
    assert error_m(map_) < 1e-6
    assert "imu" not in json.loads(str(map_.missions.sensors[0]))
