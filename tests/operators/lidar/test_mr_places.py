"""Robots with a LiDAR alone in the rooms of W-MR: they find each other, and each finds itself in a map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.lidar.places.find_places import SOURCE, FindPlacesConfig, find_places
from mapstream.operators.lidar.places.localize_lidar import LocalizeLidar, LocalizeLidarConfig
from mapstream.operators.lidar.places.place_matcher import PlaceMatchingConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps import load_map, save_map
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapPose, Odometry, PointCloud
from tests.operators.lidar.drives import OTHER_MISSION, both, stored, submap_of, worst_edge_m
from tests.operators.lidar.mr_clouds import Sights, way

pytestmark = [pytest.mark.anyio, pytest.mark.slow]
SECOND_NS = 10**9
DRIFT = SE3.exp([0, 0, 0.002, 0.005, 0.003, 0])  # in each step
LOOKS = {"cell_m": 0.1, "tolerance_m": 0.3, "min_inliers": 10}  # of rooms, which are small
# A finer look finds places more often, but also in another building: the walls of all are alike.
ROOMS = FindPlacesConfig(spacing_m=1.0)


def test_I12_two_robots_in_one_building_merge_from_unknown_starts(tmp_path: Path) -> None:
    """They share a room and the corridor; where they begin to each other nobody says."""
    truths = [way(number, 0.6, 30.0) for number in (0, 1)]
    first = submap_of(truths[0], DRIFT, world=Sights())
    second = submap_of(truths[1], DRIFT, world=Sights(), mission=OTHER_MISSION, seed=100)

    found, report = find_places(
        both(stored(first, tmp_path), stored(second, tmp_path)), ROOMS, tmp_path
    )

    assert report.num_between >= 1
    assert worst_edge_m(found, SOURCE, truths) < 0.1  # none is false
    assert found.missions.is_base_frame_known.all()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rooms") / "map"
    drive = submap_of(way(0, 0.6, 30.0), SE3.identity(), world=Sights())
    save_map(stored(drive, path), path)
    return path


async def located(folder: Path, truth: list[SE3], sights: Sights) -> list[MapPose]:
    """Return the poses of a robot whose odometry knows of no kidnapping, two in a second."""
    T_odom, odometry, clouds = SE3.identity(), list[Odometry](), list[PointCloud]()
    for k, T in enumerate(truth):
        step = truth[k - 1].inverse() @ T if k else SE3.identity()
        T_odom = T_odom @ (SE3.identity() if np.linalg.norm(step.t) > 1.0 else step) @ DRIFT
        stamp_ns = k * SECOND_NS // 2
        odometry.append(Odometry(stamp_ns=stamp_ns, T_odom_base=T_odom))
        clouds.append(PointCloud(stamp_ns=stamp_ns, points=sights(T, 500 + k)))
    config = LocalizeLidarConfig(
        map=folder,
        period_s=0.0,
        late_s=0.0,
        neighbours=0,
        spacing_m=0.6,
        places=PlaceMatchingConfig(num_proposals=5, recognizer_options=dict(LOOKS)),
    )
    operator = LocalizeLidar(config)
    poses: list[MapPose] = (await run_operator(operator, clouds=clouds, odometry=odometry))["poses"]
    return poses


async def test_U1_a_lidar_alone_is_found_in_rooms_and_again_where_it_is_carried(
    folder: Path,
) -> None:
    """It goes the other way than the one who made the map; carried into the other room it is back within 5 s."""
    there = way(7, 0.4, 30.0)
    truth = [*there[:9], *there[50:60]]
    before = load_map(folder).digest()

    poses = await located(folder, truth, Sights())

    first = next(k for k, pose in enumerate(poses) if pose.state != "lost")
    back = next(k for k in range(9, 19) if poses[k].state == "recovered")
    assert first <= 7
    assert (back - 9) * 0.5 < 5.0
    for k in (*range(first, 9), *range(back, 19)):
        T_map_base = poses[k].T_map_base
        assert T_map_base is not None
        assert np.linalg.norm(T_map_base.t - truth[k].t) < 0.1
    assert load_map(folder).digest() == before
