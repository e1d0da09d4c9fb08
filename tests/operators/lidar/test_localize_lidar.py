"""LiDAR-only localisation in a map that was made before."""

from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.lidar.places.localize_lidar import LocalizeLidar, LocalizeLidarConfig
from mapstream.operators.lidar.places.map_clouds import MapClouds
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps import Map, load_map, save_map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapPose, Odometry, PointCloud
from tests.operators.lidar.drives import circle, stored, submap_of
from tests.operators.scenes import room, seen_from

pytestmark = pytest.mark.anyio
STEP_NS = 500_000_000
HALL = room(5, num_points=14_000, boxes=16)
OTHER_HALL = room(6, num_points=14_000, boxes=16)
DRIFT = SE3.exp([0, 0, 0.004, 0.01, 0.004, 0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lidar") / "map"
    save_map(stored(submap_of(circle(8), SE3.identity(), world=HALL), path), path)
    return path


def config(folder: Path) -> LocalizeLidarConfig:
    return LocalizeLidarConfig(map=folder, period_s=0.0, late_s=0.0, neighbours=0, spacing_m=1.5)


def drive(num: int, start: SE3) -> list[SE3]:
    """Return level poses, a step of 0.3 m and 6 degrees each."""
    return [start @ SE3.exp([0, 0, 0.1 * k, 0.3 * k, 0, 0]) for k in range(num)]


async def located(folder: Path, truth: list[SE3], world: FloatArray = HALL) -> list[MapPose]:
    """Return the poses of a robot whose odometry drifts and knows of no kidnapping."""
    T_odom, odometry, clouds = SE3.identity(), list[Odometry](), list[PointCloud]()
    for k, T in enumerate(truth):
        step = truth[k - 1].inverse() @ T if k else SE3.identity()
        carried = float(np.linalg.norm(step.t)) > 1.0
        T_odom = T_odom @ (SE3.identity() if carried else step) @ DRIFT
        odometry.append(Odometry(stamp_ns=k * STEP_NS, T_odom_base=T_odom))
        seen = seen_from(world, T, 300 + k).astype(np.float32)
        clouds.append(PointCloud(stamp_ns=k * STEP_NS, points=seen))
    operator = LocalizeLidar(config(folder))
    poses: list[MapPose] = (await run_operator(operator, clouds=clouds, odometry=odometry))["poses"]
    return poses


def error_m(pose: MapPose, truth: SE3) -> float:
    assert pose.T_map_base is not None
    return float(np.linalg.norm(pose.T_map_base.t - truth.t))


async def test_U1_a_lidar_alone_is_found_and_found_again_when_carried_elsewhere(
    folder: Path,
) -> None:
    """Lost at first, then within 10 cm; carried 4 m away it is back after 2 s; the map is as it was."""
    before = load_map(folder).digest()
    first = drive(7, SE3.exp([0, 0, 0.5, -2.5, -1.5, 0]))
    truth = [*first, *drive(8, SE3.exp([0, 0, 2.5, 2.5, 1.0, 0]))]

    poses = await located(folder, truth)

    states = [pose.state for pose in poses]
    assert states[:3] == ["lost"] * 3
    assert states[3:7] == ["tracking"] * 4
    back = states.index("recovered")
    assert (poses[back].stamp_ns - poses[7].stamp_ns) / 1e9 <= 2.0
    found = [(p, t) for p, t in zip(poses, truth, strict=True) if p.state == "tracking"]
    settled = [pair for pair in found if pair[0].stamp_ns < 7 * STEP_NS] + found[-3:]
    assert max(error_m(pose, T) for pose, T in settled) < 0.1
    assert load_map(folder).digest() == before


async def test_U1_a_robot_in_another_building_stays_lost(folder: Path) -> None:
    poses = await located(folder, drive(4, SE3.identity()), OTHER_HALL)

    assert [pose.state for pose in poses] == ["lost"] * 4
    assert all(pose.verdict for pose in poses[1:])


def test_U1_single_clouds_are_found_from_anywhere(folder: Path) -> None:
    places = MapClouds(load_map(folder), folder, config(folder))
    rng = np.random.default_rng(3)
    num_right = 0
    for k in range(12):
        x, y, yaw = rng.uniform([-3, -2, -np.pi], [3, 2, np.pi])
        truth = SE3.exp([0, 0, 0, x, y, 0]) @ SE3.exp([0, 0, yaw, 0, 0, 0])
        found = places.anywhere(seen_from(HALL, truth, 500 + k))
        if found.T_map_base is not None:
            assert np.linalg.norm(found.T_map_base.t - truth.t) < 0.1
            num_right += 1

    assert num_right >= 0.95 * 12


def test_a_map_without_clouds_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no mission that is anchored has clouds"):
        MapClouds(Map.empty(), tmp_path, config(tmp_path))
