"""Planes in the scans of a LiDAR that drives through a room."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from mapstream.operators.estimation.batch import optimize_map
from mapstream.operators.planes.cloud_planes import CloudPlanes, CloudPlanesConfig
from mapstream.operators.planes.plane_landmarks import PlaneLandmarks, PlaneLandmarksConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps.build import new_mission
from mapstream.recordings.maps.constraints import add_constraints
from mapstream.recordings.maps.ids import id_array, id_bytes, vertex_id
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Vertices
from mapstream.recordings.worlds.box_room import Drive, box_room, drive_through
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import OperatorError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.planes import PlaneSegments
from tests.data import shared
from tests.operators.estimation.problems import MISSION, with_edge

WALLS = {  # normals into the room of 12 m x 12 m x 4 m, and how far they are from its middle
    (1, 0, 0): 6.0, (-1, 0, 0): 6.0, (0, 1, 0): 6.0, (0, -1, 0): 6.0, (0, 0, 1): 0.5, (0, 0, -1): 3.5,
}  # fmt: skip
SMALL = CloudPlanesConfig(min_points=40, voxel_size_m=0.25, max_distance_m=0.05)


@cache
def drive() -> Drive:
    return drive_through(box_room(3, num_boxes=8), num_scans=4, speed_mps=3.0, turn_radps=0.5)


def clouds() -> list[PointCloud]:
    """Each scan as it would be at its start, by the truth."""
    made = []
    for scan in drive().scans:
        assert scan.offsets_ns is not None
        poses = drive().truth.at(scan.stamp_ns + scan.offsets_ns)
        start = drive().truth.pose_at(scan.stamp_ns)
        moved = np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points) + poses[:, :3, 3]
        made.append(
            PointCloud(stamp_ns=scan.stamp_ns, points=(start.inverse() @ moved).astype(np.float32))
        )
    return made


def truth_of(T_world_plane: FloatArray) -> tuple[float, float]:
    """The angle [deg] to the nearest wall and the distance from it [m]."""
    normal, distance = max(
        WALLS.items(), key=lambda wall: float(np.dot(wall[0], T_world_plane[:3, 2]))
    )
    cosine = np.clip(np.dot(normal, T_world_plane[:3, 2]), -1, 1)
    return float(np.rad2deg(np.arccos(cosine))), float(
        np.dot(normal, T_world_plane[:3, 3]) + distance
    )


def test_N4_the_walls_of_a_room_are_found_in_a_scan() -> None:
    """All but the ceiling, which no beam reaches; normals within 1 deg, places within 2 cm, with 5 mm of noise; and what stands there is not a wall."""
    planes = CloudPlanes(SMALL).find(clouds()[0])

    poses = drive().truth.pose_at(planes.stamp_ns).matrix @ planes.T_base_plane
    found = [truth_of(T) for T in poses]
    walls = [row for row, (angle, off) in enumerate(found) if angle < 5 and abs(off) < 0.2]
    assert {tuple(np.rint(poses[row, :3, 2]).astype(int)) for row in walls} == set(WALLS) - {
        (0, 0, -1)
    }
    assert max(found[row][0] for row in walls) < 1.0
    assert max(abs(found[row][1]) for row in walls) < 0.02
    assert (planes.num_points >= SMALL.min_points).all()


def test_N4_the_same_scan_gives_the_same_planes() -> None:
    first, second = (CloudPlanes(SMALL).find(clouds()[1]) for _ in range(2))

    np.testing.assert_array_equal(first.T_base_plane, second.T_base_plane)
    np.testing.assert_array_equal(first.covariances, second.covariances)


@pytest.mark.anyio
async def test_N4_planes_of_clouds_alone_give_the_poses() -> None:
    """Landmarks of the same kind as those of depth images, from odometry that is off by up to 0.2 m: 2 cm."""
    found = [CloudPlanes(SMALL).find(cloud) for cloud in clouds()]
    truth = np.array([drive().truth.pose_at(planes.stamp_ns).matrix for planes in found])
    drift = [SE3.exp([0, 0, 0.01 * k, 0.04 * k, -0.06 * k, 0.0]) for k in range(len(truth))]
    odometry = [
        Odometry(stamp_ns=planes.stamp_ns, T_odom_base=SE3(T) @ off)
        for planes, T, off in zip(found, truth, drift, strict=True)
    ]

    chosen = PlaneLandmarksConfig(at_once=1.0)
    out = await run_operator(PlaneLandmarks(chosen), config=chosen, planes=found, odometry=odometry)

    map_ = mission(odometry)
    map_ = add_constraints(map_, MISSION, out["constraints"])
    map_ = with_edge(map_, "fixed", vertex_a=0, T_a_b=truth[0])
    solved, _ = optimize_map(map_)
    off_m = np.linalg.norm(solved.vertices.T_mission_base[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert off_m.max() < 0.02


def mission(odometry: list[Odometry]) -> Map:
    stamps = [each.stamp_ns for each in odometry]
    vertices = Vertices(
        id=id_array(vertex_id(id_bytes(MISSION), stamp) for stamp in stamps),
        mission=np.zeros(len(stamps), np.int64),
        stamp_ns=np.array(stamps),
        T_mission_base=np.array([each.T_odom_base.matrix for each in odometry]),
    )
    empty = new_mission(Map.empty(), MISSION)
    return replace(empty, vertices=vertices)


@pytest.mark.anyio
async def test_scans_and_clouds_come_in_and_one_of_them_is_needed() -> None:
    out = await run_operator(CloudPlanes(SMALL), scans=drive().scans[:2])

    assert [type(planes) for planes in out["planes"]] == [PlaneSegments] * 2
    with pytest.raises(OperatorError, match="connect clouds or scans"):
        await run_operator(CloudPlanes(SMALL))


def test_a_cloud_of_nothing_has_no_planes() -> None:
    nothing = PointCloud(stamp_ns=0, points=np.empty((0, 3), np.float32))

    assert len(CloudPlanes(SMALL).find(nothing)) == 0


@pytest.mark.slow
def test_N4_a_street_and_its_facade_are_found_in_real_scans() -> None:
    """KITTI: the road lies where the car's wheels are, 1.73 m below the LiDAR, within 0.2 m."""
    from mapstream.recordings.decoding import decoder_for  # noqa: PLC0415
    from mapstream.recordings.recording import open_recording  # noqa: PLC0415
    from mapstream.streams.messages.sensors import LidarScan  # noqa: PLC0415

    with open_recording(shared("kitti_camera_lidar") / "kitti_camera_lidar.mcap") as recording:
        topic = "/velodyne_points"
        decode = decoder_for(recording.topics[topic].channel, LidarScan)
        scan = decode(next(iter(recording.messages([topic]))))
    assert isinstance(scan, LidarScan)
    planes = CloudPlanes(CloudPlanesConfig()).find(scan)

    T = planes.T_base_plane
    road = int(np.argmax(planes.num_points))
    assert T[road, 2, 2] > 0.99
    assert -T[road, :3, 3] @ T[road, :3, 2] == pytest.approx(1.73, abs=0.2)
    assert (np.abs(T[:, 1, 2]) > 0.97).any()  # along the street
