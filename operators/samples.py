"""A few small messages of each kind, for checking an operator that nobody knows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import (
    Keyframe,
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
    OrganizedCloud,
    TransformBatch,
    WheelOdometry,
)
from mapstream.streams.messages.vision import GlobalDescriptor, ImageFeatures, NFrame

PERIOD_NS = 100_000_000
START_NS = 1_700_000_000_000_000_000
_MISSION = "0" * 31 + "1"


def has_samples(message_type: object) -> bool:
    """Return whether `samples` knows a type."""
    return message_type in _MAKERS


def samples(message_type: type, count: int = 5) -> list[Any]:
    """Return messages of a type: a robot that drives 0.1 m between two of them, in a box of points.

    Raises:
        KeyError: If there are none of this type, see `has_samples`.
    """
    make = _MAKERS[message_type]
    return [make(START_NS + i * PERIOD_NS, i) for i in range(count)]


def _pose(i: int) -> SE3:
    return SE3.exp([0.0, 0.0, 0.0, 0.1 * i, 0.0, 0.0])


def _points(i: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Return 600 points on the walls of a box of 10 x 8 x 3 m, as seen after 0.1 m per message."""
    rng = np.random.default_rng(7)
    half = np.array([5.0, 4.0, 1.5])
    points = rng.uniform(-half, half, (600, 3))
    axis = rng.integers(0, 3, 600)
    points[np.arange(600), axis] = half[axis] * rng.choice([-1.0, 1.0], 600)
    return (points - [0.1 * i, 0.0, 0.0]).astype(np.float32)


def _scan(stamp_ns: int, i: int) -> LidarScan:
    offsets_ns = np.linspace(0, PERIOD_NS * 0.9, 600).astype(np.int64)
    return LidarScan(stamp_ns=stamp_ns, points=_points(i), offsets_ns=offsets_ns)


def _organized(stamp_ns: int, i: int) -> OrganizedCloud:
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 40), np.linspace(-0.4, 0.4, 30))
    points = np.stack([x, y, np.ones_like(x)], axis=2) * (2 + 0.01 * i)
    return OrganizedCloud(stamp_ns=stamp_ns, points=points.astype(np.float32))


def _cloud(stamp_ns: int, i: int) -> PointCloud:
    return PointCloud(stamp_ns=stamp_ns, points=_points(i))


def _odometry(stamp_ns: int, i: int) -> Odometry:
    return Odometry(stamp_ns=stamp_ns, T_odom_base=_pose(i), covariance=np.eye(6) * 1e-4)


def _keyframe(stamp_ns: int, i: int) -> Keyframe:
    return Keyframe(stamp_ns=stamp_ns, odometry=_odometry(stamp_ns, i), cloud=_cloud(stamp_ns, i))


def _submap(stamp_ns: int, i: int) -> Submap:
    first_ns = stamp_ns - PERIOD_NS
    edge = RelativePose(
        kind="odometry",
        mission_a=_MISSION,
        stamp_a_ns=first_ns,
        mission_b=_MISSION,
        stamp_b_ns=stamp_ns,
        T_a_b=_pose(1),
        covariance=np.eye(6) * 1e-4,
    )
    keyframes = (_keyframe(first_ns, i - 1), _keyframe(stamp_ns, i))
    return Submap(mission_id=_MISSION, index=i, keyframes=keyframes, edges=(edge,))


def _correction(stamp_ns: int, i: int) -> MapCorrection:
    return MapCorrection(
        stamp_ns=stamp_ns,
        mission_id=_MISSION,
        stamps_ns=np.array([stamp_ns]),
        T_mission_base=_pose(i).matrix[None],
        T_mission_odom=SE3.identity(),
    )


def _map_pose(stamp_ns: int, i: int) -> MapPose:
    return MapPose(
        stamp_ns=stamp_ns, state="tracking", T_map_base=_pose(i), T_map_odom=SE3.identity()
    )


def _imu(stamp_ns: int, _: int) -> ImuBatch:
    stamps_ns = stamp_ns + np.arange(20) * PERIOD_NS // 20
    accel_mps2 = np.tile([0.0, 0.0, 9.81], (20, 1))
    return ImuBatch(stamps_ns=stamps_ns, gyro_radps=np.zeros((20, 3)), accel_mps2=accel_mps2)


def _frame(stamp_ns: int, i: int) -> CameraFrame:
    image = np.random.default_rng(7).integers(0, 255, (120, 160), np.uint8)
    return CameraFrame(stamp_ns=stamp_ns, image=np.roll(image, i, axis=1), encoding="mono8")


def _features(stamp_ns: int, i: int) -> ImageFeatures:
    rng = np.random.default_rng(7)
    return ImageFeatures(
        stamp_ns=stamp_ns,
        kind="orb",
        frame="camera",
        keypoints_px=rng.uniform(0, 100, (30, 2)).astype(np.float32) + i,
        descriptors=rng.integers(0, 255, (30, 32), np.uint8),
    )


def _n_frame(stamp_ns: int, i: int) -> NFrame:
    return NFrame(stamp_ns=stamp_ns, features=(_features(stamp_ns, i),))


def _descriptor(stamp_ns: int, i: int) -> GlobalDescriptor:
    vector = np.cos(np.arange(64) + 0.1 * i).astype(np.float32)
    return GlobalDescriptor(stamp_ns=stamp_ns, kind="vlad", frame="camera", vector=vector)


def _laser(stamp_ns: int, _: int) -> LaserScan2D:
    return LaserScan2D(
        stamp_ns=stamp_ns,
        ranges_m=np.full(180, 5.0, np.float32),
        angle_min_rad=-np.pi / 2,
        angle_step_rad=np.pi / 180,
        range_min_m=0.1,
        range_max_m=30.0,
    )


def _fix(stamp_ns: int, i: int) -> GnssFix:
    return GnssFix(stamp_ns=stamp_ns, latitude_deg=47.0 + i * 1e-6, longitude_deg=8.0, altitude_m=0)


def _wheels(stamp_ns: int, i: int) -> WheelOdometry:
    return WheelOdometry(stamp_ns=stamp_ns, T_odom_base=_pose(i))


def _transforms(stamp_ns: int, _: int) -> TransformBatch:
    return TransformBatch(
        stamps_ns=np.array([stamp_ns]),
        parents=("base",),
        children=("lidar",),
        T_parent_child=np.eye(4)[None],
    )


def _png(stamp_ns: int, _: int) -> EncodedImage:
    """Return the smallest PNG there is: one grey pixel."""
    data = bytes.fromhex(
        "89504e470d0a1a0a0000000d49484452000000010000000108000000003a7e9b55"
        "0000000a49444154081d6368000000820081f0aae3220000000049454e44ae426082"
    )
    return EncodedImage(stamp_ns=stamp_ns, data=np.frombuffer(data, np.uint8), format="png")


_MAKERS: dict[object, Callable[[int, int], Any]] = {
    CameraFrame: _frame,
    EncodedImage: _png,
    GlobalDescriptor: _descriptor,
    GnssFix: _fix,
    ImageFeatures: _features,
    NFrame: _n_frame,
    ImuBatch: _imu,
    Keyframe: _keyframe,
    LaserScan2D: _laser,
    LidarScan: _scan,
    LoopReport: lambda stamp_ns, _: LoopReport(stamp_ns=stamp_ns),
    MapCorrection: _correction,
    MapPose: _map_pose,
    Odometry: _odometry,
    OrganizedCloud: _organized,
    PointCloud: _cloud,
    Submap: _submap,
    TransformBatch: _transforms,
    WheelOdometry: _wheels,
}
