"""World W-2D: repeatable, true to its own plan, and two runs may go through one building."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.recordings.mcap_reader import McapRecording
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.recordings.worlds.office_drive import Route, office_drive
from mapstream.recordings.worlds.w_2d import W2dConfig, plan_of, w_2d, w_2d_floor
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.grids import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapstream.streams.messages.sensors import LaserScan2D, WheelOdometry
from mapstream.streams.trajectory import Trajectory

SMALL: dict[str, Any] = {
    "width_m": 14.0,
    "laps": 0.3,
    "visits": False,
    "laser": {"beams": 91, "rate_hz": 2.0},
}


@pytest.fixture(scope="module")
def messages() -> list[Any]:
    """What a short drive records, in order."""
    return [record.message for record in w_2d(W2dConfig.model_validate(SMALL), 0).records]


def of_type(messages: list[Any], kind: type[Any]) -> list[Any]:
    return [message for message in messages if isinstance(message, kind)]


def truth_of(messages: list[Any]) -> Trajectory:
    truth = of_type(messages, Odometry)
    return Trajectory(
        stamps_ns=np.array([m.stamp_ns for m in truth]),
        poses=np.array([m.T_odom_base.matrix for m in truth]),
    )


def ends_of(scan: LaserScan2D, truth: Trajectory) -> FloatArray:
    """Return where the beams that returned ended (N, 2), each from where the robot then was."""
    seen = np.flatnonzero(np.isfinite(scan.ranges_m))
    angles = scan.angle_min_rad + seen * scan.angle_step_rad
    rays = np.stack([np.cos(angles), np.sin(angles), 0 * angles, 0 * angles], axis=1)
    points = scan.ranges_m[seen, None] * rays + [0, 0, 0, 1]
    T = truth.at(scan.stamp_ns + seen * scan.beam_period_ns) @ scan.T_base_sensor.matrix
    ends: FloatArray = np.einsum("nij,nj->ni", T, points)[:, :2]
    return ends


def test_A6_R9_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a.mcap", "b.mcap", "c.mcap")]
    for path, seed in zip(paths, (3, 3, 4), strict=True):
        simulate("w_2d", path, seed=seed, **SMALL | {"laps": 0.05})

    a, b, c = (path.read_bytes() for path in paths)
    assert a == b
    assert a != c
    with McapRecording(paths[0]) as recording:
        assert set(recording.topics) == {"/scan", "/odom", "/truth", "/truth/plan"}


def test_A6_beams_end_on_the_walls_once_their_motion_is_undone(messages: list[Any]) -> None:
    """A step of 3 cm ahead of where a beam ended is free, and 3 cm behind it is solid; noise is 1 cm."""
    truth = truth_of(messages)
    floor = w_2d_floor(W2dConfig.model_validate(SMALL), 0)
    scans = of_type(messages, LaserScan2D)[4:-4:4]
    assert scans
    for scan in scans:
        ends = ends_of(scan, truth)
        origin = (truth.pose_at(scan.stamp_ns) @ scan.T_base_sensor).t[:2]
        step = 0.035 * (ends - origin) / np.linalg.norm(ends - origin, axis=1, keepdims=True)
        assert (~floor.is_solid(ends - step)).mean() > 0.98
        assert floor.is_solid(ends + step).mean() > 0.9  # corners are grazed


def test_a_drive_starts_at_the_origin_of_the_plan(messages: list[Any]) -> None:
    """So maps are in the frame of the truth."""
    np.testing.assert_allclose(truth_of(messages).poses[0], np.eye(4), atol=1e-9)


def test_the_plan_is_in_the_recording(messages: list[Any]) -> None:
    (plan,) = of_type(messages, OccupancyGrid)
    counts = {value: int((plan.cells == value).sum()) for value in (FREE, OCCUPIED, UNKNOWN)}
    assert sum(counts.values()) == plan.cells.size
    assert counts[FREE] * plan.resolution_m**2 == pytest.approx(14 * 17, rel=0.2)

    cells = np.floor((invert(plan.T_map_grid.matrix) @ truth_of(messages).poses)[:, :2, 3] / 0.05)
    columns, rows = cells.astype(int).T
    assert (plan.cells[rows, columns] == FREE).all()


def test_two_runs_go_through_one_building() -> None:
    """Another seed with the first one's building: the same plan, another way."""
    first, second, third = (
        w_2d(W2dConfig.model_validate(SMALL | {"building_seed": building}), seed)
        for building, seed in ((None, 0), (0, 1), (None, 1))
    )
    plans, ways = [], []
    for simulation in (first, second, third):
        messages = [r.message for r in simulation.records if r.topic != "/scan"]
        plans.append(of_type(messages, OccupancyGrid)[0].cells)
        ways.append(truth_of(messages).poses)

    np.testing.assert_array_equal(plans[0], plans[1])
    assert not np.array_equal(plans[0], plans[2])
    assert not np.array_equal(ways[0], ways[1])


@pytest.mark.parametrize("seed", range(4))
def test_the_robot_drives_through_free_space(seed: int) -> None:
    """In every room of a building, 0.3 m around the robot are free."""
    floor = w_2d_floor(W2dConfig(), seed)
    route = Route(laps=1.0, visits=True, is_reverse=seed % 2 == 1, speed_mps=0.8)
    motion = office_drive(floor, route, 0, np.random.default_rng(seed))
    places = motion.poses(np.arange(0, motion.end_ns, 10**8))
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rim = 0.3 * np.stack([np.cos(angles), np.sin(angles)], axis=1)

    around = places[::5, None, :2, 3] + rim
    assert not floor.is_solid(around).any()
    for room in floor.rooms:
        middle = [room.door_m, sum(room.y_m) / 2]
        assert np.linalg.norm(places[:, :2, 3] - middle, axis=1).min() < 0.5


def test_wheels_drift_and_the_robot_is_holonomic(messages: list[Any]) -> None:
    truth, wheels = truth_of(messages), of_type(messages, WheelOdometry)
    T = np.array([m.T_odom_base.matrix for m in wheels])
    true = invert(truth.poses[0]) @ truth.poses[-1]
    steps = invert(truth.poses[:-10]) @ truth.poses[10:]
    way_m = np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1).sum()

    assert 0.002 < np.linalg.norm((invert(true) @ T[-1])[:3, 3]) / way_m < 0.2
    assert np.abs(steps[:, 1, 3]).max() > 0.5 * np.linalg.norm(steps[:, :2, 3], axis=1).max()


def test_blank_corridors_have_no_doors() -> None:
    floor = w_2d_floor(W2dConfig(blank_walls=True), 0)

    assert floor.rooms == ()
    assert len(floor.boxes) == 4 + 6
    assert (plan_of(floor).cells == FREE).any()
