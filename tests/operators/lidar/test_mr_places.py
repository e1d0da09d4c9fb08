"""Robots with a LiDAR alone in the rooms of W-MR: they find each other, and each finds itself in a map."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.operators.lidar.places.find_places import SOURCE, FindPlacesConfig, find_places
from mapstream.operators.lidar.places.localize_lidar import LocalizeLidar, LocalizeLidarConfig
from mapstream.operators.lidar.places.place_matcher import ACCEPTED, PlaceMatchingConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps import load_map, save_map
from mapstream.recordings.maps.combine import merge_maps
from mapstream.recordings.maps.model import Map
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapPose, Odometry, PointCloud
from tests.operators.lidar.drives import MISSION, OTHER_MISSION, stored, submap_of, worst_edge_m
from tests.operators.lidar.mr_clouds import Sights, way

pytestmark = [pytest.mark.anyio, pytest.mark.slow]
THIRD_MISSION = "0" * 31 + "3"
SECOND_NS = 10**9
DRIFT = SE3.exp([0, 0, 0.002, 0.005, 0.003, 0])  # in each step
OTHER_BUILDING = 1  # than 0
COARSE = FindPlacesConfig(spacing_m=1.0)
# Rooms are small; the finer look takes one for another, unless nearly all that is seen must fit.
ROOMS: dict[str, Any] = {
    "num_proposals": 5,
    "recognizer_options": {"cell_m": 0.1, "tolerance_m": 0.3, "min_inliers": 10},
    "min_inlier_fraction": 0.8,
}
FINE = FindPlacesConfig(spacing_m=0.6, neighbours=0, **ROOMS)


TRUTHS = [way(0, 0.6, 30.0), way(1, 0.6, 30.0), way(0, 0.6, 15.0, OTHER_BUILDING)]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> tuple[Map, Path]:
    """Return the missions of three robots, and where their clouds are; the last is in another building."""
    path = tmp_path_factory.mktemp("fleet")
    first = submap_of(TRUTHS[0], DRIFT, world=Sights())
    second = submap_of(TRUTHS[1], DRIFT, world=Sights(), mission=OTHER_MISSION, seed=100)
    away = Sights(OTHER_BUILDING)
    third = submap_of(TRUTHS[2], DRIFT, world=away, mission=THIRD_MISSION, seed=200)
    return merge_maps([stored(each, path) for each in (first, second, third)]), path


@pytest.mark.parametrize("config", [COARSE, FINE], ids=["coarse", "fine"])
def test_I12_two_robots_in_one_building_merge_from_unknown_starts_and_one_in_another_does_not(
    fleet: tuple[Map, Path], config: FindPlacesConfig
) -> None:
    """Two share a room and the corridor; where they begin to each other nobody says, nor where the third is."""
    found, report = find_places(fleet[0], config, fleet[1])

    assert report.num_between >= 3
    between = [place for place in report.places if place.mission_a != place.mission_b]
    believed = [place for place in between if place.verdict == ACCEPTED]
    assert {(place.mission_a, place.mission_b) for place in believed} == {(MISSION, OTHER_MISSION)}
    assert worst_edge_m(found, SOURCE, TRUTHS) < 0.1  # none is false
    assert found.missions.is_base_frame_known.tolist() == [True, True, False]


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
        places=PlaceMatchingConfig(**ROOMS),
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


@pytest.mark.parametrize("number", [0, 7])
async def test_U1_a_lidar_in_another_building_stays_lost(folder: Path, number: int) -> None:
    """It would go the same way, or the other way round, if the walls stood where they stand in the map."""
    there = way(number, 0.4, 30.0, OTHER_BUILDING)[::4]

    poses = await located(folder, there, Sights(OTHER_BUILDING))

    assert len(poses) >= 18
    assert {pose.state for pose in poses} == {"lost"}
