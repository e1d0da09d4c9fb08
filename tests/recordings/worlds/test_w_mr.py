"""World W-MR: robots of four kinds see one building, each from its own way."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from mapstream.recordings.attached_rig import rig_of
from mapstream.recordings.mcap_reader import McapRecording
from mapstream.recordings.worlds.building import building
from mapstream.recordings.worlds.building_plan import Plan
from mapstream.recordings.worlds.building_tour import NUM_WAYS, tour
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.recordings.worlds.mr_config import WMrConfig
from mapstream.recordings.worlds.mr_rig import ROBOTS, T_BASE_LIDAR, T_BASE_RGBD
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.recordings.worlds.surface_mesh import mesh_of
from mapstream.recordings.worlds.w_mr import w_mr
from mapstream.streams.arrays import FloatArray

SMALL: dict[str, Any] = {
    "duration_s": 2.0,
    "texel_m": 0.2,
    "camera": {"width_px": 128, "height_px": 96, "rate_hz": 2.0},
    "rgbd": {"width_px": 128, "height_px": 96, "rate_hz": 2.0},
    "lidar": {"beams": 16, "columns": 128, "rate_hz": 5.0},
    "objects_hz": 2.0,
}
TOPICS = {
    "camera": {"/front_left/image", "/front_right/image", "/front_left/objects", "/imu"},
    "lidar": {"/points", "/wheels"},
    "rgbd": {"/color/image", "/depth/image", "/color/objects"},
    "full": {
        *("/front_left/image", "/front_right/image", "/front_left/objects", "/imu"),
        *("/points", "/wheels", "/gnss"),
    },
}


def by_topic(**options: Any) -> dict[str, list[Any]]:  # noqa: ANN401  # as in a config
    records: dict[str, list[Any]] = {}
    for each in w_mr(WMrConfig.model_validate(SMALL | options), 0).records:
        records.setdefault(each.topic, []).append(each)
    return records


@pytest.mark.slow
@pytest.mark.parametrize("robot", list(ROBOTS))
def test_R9_the_same_seed_gives_the_same_bytes_and_each_robot_what_it_has(
    tmp_path: Path, robot: str
) -> None:
    names = ("a.mcap", "b.mcap") if robot in ("full", "rgbd") else ("a.mcap",)
    paths = [tmp_path / name for name in names]
    for path in paths:
        simulate("w_mr", path, seed=3, **SMALL, robot=robot, number=4)

    assert paths[0].read_bytes() == paths[-1].read_bytes()
    with McapRecording(paths[0]) as recording:
        found = set(recording.topics) - {"/truth", "/truth/things", "/truth/objects", "/odometry"}
        assert found == TOPICS[robot]
    rig = rig_of(paths[0])
    assert rig is not None
    hung = {sensor.topic for sensor in rig.sensors if sensor.topic} - {"/odometry"}
    assert hung <= TOPICS[robot]


@pytest.mark.slow
def test_all_ways_keep_clear_of_what_stands_about_and_begin_apart() -> None:
    """Nothing is nearer than 35 cm to the middle of a robot, and it never leaves the building."""
    angles = np.linspace(0, 2 * np.pi, 9, endpoint=False)
    around = np.stack([np.cos(angles), np.sin(angles), np.zeros(9)], axis=1)
    for seed in (3, 0):
        place = building(seed, texel_m=SMALL["texel_m"])
        ways = [
            tour(place.rooms, number, 60.0, 0.8, 0, is_carried=False) for number in range(NUM_WAYS)
        ]
        stamps_ns = np.arange(0, 60 * 10**9, 10**9)
        spots = np.stack([way.poses(stamps_ns)[:, :3, 3] for way in ways])
        low = np.array(spots.reshape(-1, 3))
        low[:, 2] = 0.3
        ranges_m = (
            RayCaster(mesh_of(place.surfaces))
            .cast(np.repeat(low, 9, axis=0), np.tile(around, (len(low), 1)))
            .ranges_m
        )
        assert ranges_m.min() > 0.35
        assert np.isfinite(ranges_m).all()
        apart = np.linalg.norm(spots[:, None, 0] - spots[:, 0], axis=2)
        assert apart[~np.eye(NUM_WAYS, dtype=bool)].min() > 1.0


def test_walls_and_doors_of_two_buildings_differ() -> None:
    plans = [building(seed, texel_m=SMALL["texel_m"]).plan for seed in (0, 1, 2, 1)]
    assert plans[1] == plans[3]
    for a, b in combinations(plans[:3], 2):
        sizes, doors = (np.array([of(plan) for plan in (a, b)]) for of in (_sizes_m, _doors_m))
        assert np.ptp(sizes, axis=0).max() > 0.5
        assert (np.ptp(doors, axis=0).max(axis=0) > 0.2).all()
        assert abs(a.corridor_m - b.corridor_m) > 0.05


def _sizes_m(plan: Plan) -> FloatArray:
    return np.array([np.subtract(room.high_m, room.low_m) for room in plan.rooms])


def _doors_m(plan: Plan) -> FloatArray:
    """Return where in its wall each door is, and how wide (6, 2)."""
    doors = [(room.door_m - room.middle_m[0], room.door_width_m) for room in plan.rooms]
    return np.array(doors)


def test_neighbours_share_a_room_and_all_the_corridor() -> None:
    place = building(0, texel_m=SMALL["texel_m"])
    been = []
    for number in range(NUM_WAYS):
        motion = tour(place.rooms, number, 60.0, 0.8, 0, is_carried=True)
        x, y = motion.poses(np.arange(0, 60 * 10**9, 10**9 // 2))[:, :2, 3].T
        assert (np.abs(y) < place.plan.corridor_m).any()
        rooms = {
            room.number
            for room in place.rooms
            if (np.hypot(x - room.middle_m[0], y - room.middle_m[1]) < 2.0).any()
        }
        been.append(rooms)
        assert len(rooms) == 2
    assert all(a & b for a, b in zip(been[:6], [*been[1:6], been[0]], strict=True))


@pytest.mark.parametrize("robot", ["lidar", "rgbd"])
def test_what_is_measured_lies_on_the_walls_that_cameras_see(robot: str) -> None:
    place = building(0, texel_m=SMALL["texel_m"])
    exact = {"lidar": SMALL["lidar"] | {"range_noise_m": 0}, "rgbd": SMALL["rgbd"] | {"noise": 0}}
    records = by_topic(robot=robot, **exact)
    if robot == "lidar":
        points = T_BASE_LIDAR @ records["/points"][2].message.points.astype(np.float64)
    else:
        points = T_BASE_RGBD @ _points(records["/depth/image"][2].message.image)
    seen = records["/truth"][0].message.T_odom_base @ points  # all begin at rest
    gaps_m = np.min([np.abs((seen - s.origin) @ s.normal) for s in place.surfaces], axis=0)
    assert len(seen) > 1000
    assert np.quantile(gaps_m, 0.99) < 0.01
    assert (
        np.abs(seen[:, :2]) < np.array([place.plan.length_m, place.plan.depth_m]) / 2 + 0.01
    ).all()


def _points(depth_mm: npt.NDArray[np.uint16]) -> FloatArray:
    camera = WMrConfig.model_validate(SMALL).rgbd.calibration("depth")
    rows, columns = np.nonzero(depth_mm)
    rays = (np.stack([columns, rows], axis=1) - camera.center_px) / camera.focal_px
    points: FloatArray = np.insert(rays, 2, 1.0, axis=1) * depth_mm[rows, columns][:, None] / 1000.0
    return points


def test_late_topics_become_known_late_and_in_order() -> None:
    config = WMrConfig.model_validate(
        SMALL | {"robot": "full", "delays_s": {"/gnss": 2.0, "/points": 0.3}}
    )
    records = list(w_mr(config, 0).records)
    log_ns = [record.log_ns for record in records]
    assert log_ns == sorted(log_ns)
    for record in records:
        if record.topic == "/gnss":
            assert record.log_ns - record.message.stamp_ns == 2 * 10**9
        if record.topic == "/points":
            assert record.log_ns - record.message.stamp_ns == 5 * 10**8
