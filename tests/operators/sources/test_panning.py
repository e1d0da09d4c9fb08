"""A camera that pans on the robot: its clouds fit together only where its place is asked at each stamp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import anyio
import igl
import numpy as np
import pytest

from mapstream.operators.lidar.registration import make_registration
from mapstream.operators.sources.mcap import McapSource
from mapstream.operators.sources.mcap_config import McapSourceConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.worlds.box_room import box_room
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import LidarScan
from mapstream.streams.trajectory import Trajectory


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[LidarScan], Trajectory]:
    """The clouds of a drive through the source, and the true poses of the base."""
    path: Path = tmp_path_factory.mktemp("pan") / "pan.mcap"
    simulate("w_pan", path)
    topics = {"scans": "/points", "odometry": "/truth"}
    config = McapSourceConfig.model_validate({"path": path, "topics": topics})
    sent = anyio.run(lambda: run_operator(McapSource(config), config=config))
    truth = sent["odometry"]
    return sent["scans"], Trajectory(
        stamps_ns=np.array([pose.stamp_ns for pose in truth]),
        poses=np.array([pose.T_odom_base.matrix for pose in truth]),
    )


def in_world(scans: Sequence[LidarScan], truth: Trajectory) -> FloatArray:
    """Put clouds together by the true poses and where the camera is said to sit; (N, 3)."""
    places = [truth.pose_at(scan.stamp_ns) @ scan.T_base_sensor for scan in scans]
    return np.concatenate([T @ scan.points for T, scan in zip(places, scans, strict=True)])


def frozen(scans: Sequence[LidarScan]) -> list[LidarScan]:
    """The same clouds, from a camera that is taken to sit where it sat first."""
    return [replace(scan, T_base_sensor=scans[0].T_base_sensor) for scan in scans]


def rms_to_walls(points: FloatArray) -> float:
    room = box_room(0)
    squared, _, _ = igl.point_mesh_squared_distance(points, room.vertices, room.faces)
    return float(np.sqrt(np.mean(squared)))


def test_A19_clouds_of_a_panning_camera_lie_on_the_walls(
    played: tuple[list[LidarScan], Trajectory],
) -> None:
    """2 cm hold for all points together, noise included; with one place for all they miss by far."""
    scans, truth = played

    assert len(scans) == 81
    assert rms_to_walls(in_world(scans, truth)) < 0.02
    assert rms_to_walls(in_world(frozen(scans), truth)) > 0.2


def test_A19_clouds_of_two_sweeps_of_the_pan_register_within_2_cm(
    played: tuple[list[LidarScan], Trajectory],
) -> None:
    """The camera sweeps over one side twice; registration finds nothing left to correct."""
    scans, truth = played
    first, second = scans[:25], scans[50:75]
    registration = make_registration("plane", leaf_size_m=0.1, search_distances_m=(0.3,))

    moved_m = []
    for clouds in (first, second), (frozen(first), second):
        target, source = (in_world(part, truth) for part in clouds)
        centre = source.mean(axis=0)
        T_target_source = registration.align(source, target, SE3.identity()).T_target_source
        moved_m.append(np.linalg.norm(T_target_source @ centre - centre))

    assert moved_m[0] < 0.02
    assert moved_m[1] > 0.2
