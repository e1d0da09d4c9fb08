"""One small message of each type, for tests of views."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from mapstream.recordings.maps import Map
from mapstream.recordings.maps.build import add_edges
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import (
    Keyframe,
    LoopCandidate,
    LoopReport,
    MapCorrection,
    MapPose,
    Odometry,
    PointCloud,
    RelativePose,
    Submap,
)
from mapstream.streams.messages.sensors import (
    CameraFrame,
    EncodedImage,
    GnssFix,
    ImuBatch,
    LaserScan2D,
    LidarScan,
    TransformBatch,
    WheelOdometry,
)
from mapstream.streams.messages.vision import ImageFeatures

MISSION = "ab" * 16
STEP_NS = 100_000_000
_RNG = np.random.default_rng(7)
_POINTS = (_RNG.normal(size=(50, 3)) * (5, 5, 0.1)).astype(np.float32)  # open ground
_IMAGE = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)


@cache
def pose(step: int) -> SE3:
    return SE3.exp([0.0, 0.0, 0.05 * step, 1.0 * step, 0.0, 0.0])


@cache
def odometry(step: int) -> Odometry:
    return Odometry(stamp_ns=step * STEP_NS, T_odom_base=pose(step), velocity_mps=np.ones(3))


def scan(stamp_ns: int = 0, num_points: int = 50) -> LidarScan:
    points = np.resize(_POINTS, (num_points, 3))
    return LidarScan(stamp_ns=stamp_ns, points=points, intensity=points[:, 0])


def cloud(stamp_ns: int = 0, num_points: int = 50) -> PointCloud:
    return PointCloud(stamp_ns=stamp_ns, points=np.resize(_POINTS, (num_points, 3)))


@cache
def keyframe(step: int) -> Keyframe:
    stamp_ns = step * STEP_NS
    return Keyframe(stamp_ns=stamp_ns, odometry=odometry(step), cloud=cloud(stamp_ns))


def edge(a: int, b: int, kind: str = "odometry") -> RelativePose:
    return RelativePose(
        kind=kind,  # type: ignore[arg-type]  # one of the literals
        mission_a=MISSION,
        stamp_a_ns=a * STEP_NS,
        mission_b=MISSION,
        stamp_b_ns=b * STEP_NS,
        T_a_b=pose(a).inverse() @ pose(b),
        covariance=np.eye(6),
        is_switchable=kind == "loop",
    )


@cache
def submap(index: int = 0, length: int = 3) -> Submap:
    first = index * length
    steps = range(first, first + length + 1)
    return Submap(
        mission_id=MISSION,
        index=index,
        keyframes=tuple(keyframe(step) for step in steps),
        edges=tuple(edge(step, step + 1) for step in list(steps)[:-1]),
    )


@cache
def correction(num_poses: int = 4, shift_m: float = 0.0) -> MapCorrection:
    poses = np.stack([pose(step).matrix for step in range(num_poses)])
    poses[:, 1, 3] += shift_m
    return MapCorrection(
        stamp_ns=(num_poses - 1) * STEP_NS,
        mission_id=MISSION,
        stamps_ns=np.arange(num_poses) * STEP_NS,
        T_mission_base=poses,
        T_mission_odom=SE3.from_rotation(np.eye(3), (0.0, shift_m, 0.0)),
    )


def map_poses() -> list[MapPose]:
    """A robot that is lost, found, lost again, and recovered elsewhere."""
    T_map_odom = SE3.from_rotation(np.eye(3), (0.0, 5.0, 0.0))
    poses = []
    for step, state in enumerate(["lost", "tracking", "tracking", "lost", "recovered"]):
        is_lost = state == "lost"
        poses.append(
            MapPose(
                stamp_ns=step * STEP_NS,
                state=state,  # type: ignore[arg-type]  # one of the literals
                T_map_base=None if is_lost else T_map_odom @ pose(step),
                T_map_odom=None if is_lost else T_map_odom,
                num_inliers=0 if is_lost else 40,
                verdict="3 matches, which speak of no place" if is_lost else "accepted",
            )
        )
    return poses


def loop_report() -> LoopReport:
    accepted = LoopCandidate(
        stamp_a_ns=0,
        stamp_b_ns=3 * STEP_NS,
        distance_m=1.0,
        verdict="accepted",
        inlier_fraction=0.9,
        rmse_m=0.05,
    )
    refused = LoopCandidate(
        stamp_a_ns=0, stamp_b_ns=2 * STEP_NS, distance_m=9.0, verdict="too few inliers"
    )
    edges = (edge(0, 3, kind="loop"),)
    return LoopReport(stamp_ns=3 * STEP_NS, edges=edges, candidates=(accepted, refused))


@cache
def made_map() -> Map:
    return add_edges(append_submap(Map.empty(), submap()), [edge(0, 3, kind="loop")])


def encoded_image(format: str = "jpeg") -> EncodedImage:  # noqa: A002  # as in the message
    data = cv2.imencode(".jpg", _IMAGE)[1]
    return EncodedImage(stamp_ns=0, data=np.frombuffer(data.tobytes(), np.uint8), format=format)


def camera_frame(encoding: str = "mono8", stamp_ns: int = 0) -> CameraFrame:
    dtype = {"16UC1": np.uint16, "32FC1": np.float32}.get(encoding, np.uint8)
    image = _IMAGE.astype(dtype)
    if encoding in ("bgr8", "rgb8"):
        image = np.stack([image] * 3, axis=-1)
    return CameraFrame(stamp_ns=stamp_ns, image=image, encoding=encoding)


def sensor_messages() -> dict[str, object]:
    stamps = np.arange(5) * STEP_NS
    return {
        "scans": scan(),
        "imu": ImuBatch(stamps_ns=stamps, gyro_radps=np.ones((5, 3)), accel_mps2=np.ones((5, 3))),
        "laser": LaserScan2D(
            stamp_ns=0,
            ranges_m=np.array([1, np.nan, 3], np.float32),
            angle_min_rad=0.0,
            angle_step_rad=0.1,
            range_min_m=0.1,
            range_max_m=30.0,
        ),
        "gnss": GnssFix(stamp_ns=0, latitude_deg=47.0, longitude_deg=8.0, altitude_m=400.0),
        "wheels": WheelOdometry(stamp_ns=0, T_odom_base=SE3.identity()),
        "tf": TransformBatch(
            stamps_ns=np.zeros(1, np.int64),
            parents=("base_link",),
            children=("os_lidar",),
            T_parent_child=np.eye(4)[None],
        ),
        "features": ImageFeatures(
            stamp_ns=0,
            kind="orb",
            frame="camera",
            keypoints_px=np.ones((4, 2), np.float32),
            descriptors=np.zeros((4, 32), np.uint8),
            scores=np.arange(4, dtype=np.float32),
        ),
    }
