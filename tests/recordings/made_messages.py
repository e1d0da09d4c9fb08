"""One message of every class, made of random but valid content, for round trips."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import (
    Constraint,
    LandmarkRef,
    LoopClosure,
    OuterFrame,
)
from mapstream.streams.messages.estimates import (
    Keyframe,
    LoopCandidate,
    LoopReport,
    MapCorrection,
    MapPose,
    Odometry,
    PointCloud,
    RelativePose,
    Splice,
    Submap,
)
from mapstream.streams.messages.grids import OccupancyGrid
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.planes import PlaneSegments
from mapstream.streams.messages.sensors import (
    CameraFrame,
    EncodedImage,
    GnssFix,
    ImuBatch,
    LaserScan2D,
    LidarScan,
    OrganizedCloud,
    RecordRef,
    TransformBatch,
    WheelOdometry,
)
from mapstream.streams.messages.vision import GlobalDescriptor, ImageFeatures, NFrame


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """A message that somebody else wrote."""

    stamp_ns: int
    label: Literal["car", "tree"]
    corners: tuple[float, ...]
    scores: dict[str, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Beacon:
    """Another one, that a recording can hold."""

    stamp_ns: int
    label: Literal["car", "tree"] = "car"
    ranges: tuple[float, ...] = ()
    strength: float | None = None
    is_near: bool = False
    raw: bytes = b""


def one_of_each(seed: int) -> list[Any]:
    """Return messages whose optional parts are there or not, by the seed."""
    rng = np.random.default_rng(seed)
    stamp = int(rng.integers(1, 2**62))
    n = int(rng.integers(0, 5))
    mission = rng.bytes(16).hex()

    def maybe(value: Any) -> Any:  # noqa: ANN401
        return value if rng.integers(2) else None

    def pose() -> SE3:
        return SE3.exp(rng.normal(size=6))

    def covariance() -> np.ndarray[Any, Any]:
        return rng.normal(size=(6, 6))

    ref = RecordRef(path="a.mcap", topic="/x", log_ns=stamp)
    points = rng.normal(size=(n, 3)).astype(np.float32)
    intensity = rng.random(n).astype(np.float32)
    cloud = PointCloud(
        stamp_ns=stamp, points=points, intensity=maybe(intensity),
        colors_rgba=maybe(rng.integers(0, 255, (n, 4), np.uint8)),
    )  # fmt: skip
    odometry = Odometry(
        stamp_ns=stamp,
        T_odom_base=pose(),
        covariance=maybe(covariance()),
        velocity_mps=maybe(rng.normal(size=3)),
        is_lost=bool(rng.integers(2)),
    )
    keyframe = Keyframe(
        stamp_ns=stamp, odometry=odometry, cloud=maybe(cloud), records=(ref,) * int(rng.integers(3))
    )
    edge = RelativePose(
        kind="loop", mission_a=mission, stamp_a_ns=1, mission_b=mission, stamp_b_ns=2, T_a_b=pose(),
        covariance=covariance(), is_switchable=True,
    )  # fmt: skip
    constraint = Constraint(
        stamp_ns=stamp, kind="position", T_a_b=pose(), covariance=np.diag([np.inf] * 3 + [1.0] * 3),
        outer=maybe(OuterFrame(name="enu", crs="enu", origin_lla=maybe(np.array([47.0, 8.0, 400.0])))),
        landmark=maybe(LandmarkRef(name="door", kind="plane", label="wall")), payload=rng.bytes(n),
    )  # fmt: skip
    loop = LoopClosure(
        robot_a="one", stamp_a_ns=1, robot_b=mission, stamp_b_ns=2, T_a_b=pose(), covariance=covariance(),
        quality=float(rng.random()), source="radio",
    )  # fmt: skip
    splice = Splice(keyframe=keyframe, edges=(edge, edge), constraints=(constraint,))
    imu = ImuBatch(
        stamps_ns=np.arange(n + 1), gyro_radps=rng.normal(size=(n + 1, 3)),
        accel_mps2=rng.normal(size=(n + 1, 3)), is_saturated=maybe(np.zeros(n + 1, bool)),
    )  # fmt: skip
    camera = CameraCalibration(
        stamp_ns=stamp, width_px=640, height_px=480, focal_px=rng.random(2) + 400,
        center_px=rng.random(2) + 200, distortion="radtan", distortion_parameters=rng.random(4),
    )  # fmt: skip
    objects = ObjectDetections(
        stamp_ns=stamp, frame="camera", width_px=64, height_px=48,
        boxes_px=np.tile(np.array([[1.0, 2.0, 4.0, 4.4]], np.float32), (n, 1)), labels=("cup",) * n,
        scores=rng.random(n).astype(np.float32), masks=(np.eye(4, 4, dtype=bool)[1:],) * n,
        mask_sources=("depth",) * n, points_m=(rng.random((2, 3)).astype(np.float32),) * n,
        centers_m=maybe(rng.random((n, 3)).astype(np.float32)), center_sigmas_m=maybe(np.ones(n, np.float32)),
        quats_camera_object_xyzw=maybe(np.ones((n, 4)) / 2), extents_m=maybe(np.ones((n, 3), np.float32)),
        texts=("exit",) * n, descriptors=maybe(np.ones((n, 4), np.float32)), descriptor_kind="vlad",
        track_ids=maybe(np.arange(n)), T_base_sensor=pose(), camera=maybe(camera), record=maybe(ref),
    )  # fmt: skip
    features = ImageFeatures(
        stamp_ns=stamp, kind="orb", frame="camera",
        keypoints_px=rng.random((n, 2)).astype(np.float32),
        descriptors=rng.integers(0, 255, (n, 32), np.uint8), scores=maybe(intensity),
        sigmas_px=maybe(intensity), track_ids=maybe(np.arange(n) - 1),
        points_m=maybe(rng.random((n, 3)).astype(np.float32)), offsets_ns=maybe(np.arange(n)),
        objects=maybe(objects),
        T_base_sensor=pose(), camera=maybe(camera), record=maybe(ref),
    )  # fmt: skip
    return [
        loop,
        OrganizedCloud(
            stamp_ns=stamp, points=rng.normal(size=(2, n, 3)).astype(np.float32), T_base_sensor=pose(),
            colors_rgb=maybe(rng.integers(0, 255, (2, n, 3), np.uint8)), record=maybe(ref),
        ),
        LidarScan(
            stamp_ns=stamp, points=points, intensity=maybe(intensity),
            ring=maybe(np.arange(n, dtype=np.uint16)), offsets_ns=maybe(np.arange(n) - 2),
            T_base_sensor=pose(), record=maybe(ref),
        ),
        CameraFrame(stamp_ns=stamp, image=rng.integers(0, 255, (4, 5, 3), np.uint8), encoding="bgr8"),
        CameraFrame(
            stamp_ns=stamp, image=rng.integers(0, 999, (4, 5)).astype(np.uint16), encoding="16UC1"
        ),
        EncodedImage(stamp_ns=stamp, data=np.frombuffer(rng.bytes(n), np.uint8), format="jpeg"),
        imu, constraint,
        LaserScan2D(
            stamp_ns=stamp, ranges_m=np.array([1, np.nan, 2], np.float32), angle_min_rad=-1.0,
            angle_step_rad=0.1, range_min_m=0.0, range_max_m=float("inf"), beam_period_ns=n,
        ),
        GnssFix(
            stamp_ns=stamp, latitude_deg=47.1, longitude_deg=8.2, altitude_m=-0.0,
            covariance_enu_m2=maybe(np.eye(3)),
        ),
        camera,
        WheelOdometry(stamp_ns=stamp, T_odom_base=pose(), covariance=maybe(covariance())),
        TransformBatch(
            stamps_ns=np.arange(2), parents=("a", "b"), children=("c", "d"),
            T_parent_child=np.array([pose().matrix, pose().matrix]), is_static=bool(n % 2),
        ),
        odometry, cloud, edge, keyframe,
        Submap(
            mission_id=mission, index=n, keyframes=(keyframe,) * (n + 1), edges=(edge,) * n,
            constraints=(constraint,) * n, imu=maybe(imu), splices=(splice,) * n,
        ),
        LoopReport(
            stamp_ns=stamp, edges=(edge,) * n,
            candidates=(LoopCandidate(stamp_a_ns=1, stamp_b_ns=2, distance_m=3.0, verdict="accepted"),),
        ),
        MapPose(
            stamp_ns=stamp, state="tracking", T_map_base=maybe(pose()), T_map_odom=maybe(pose()),
            covariance=maybe(covariance()), num_inliers=n, verdict="accepted",
        ),
        MapCorrection(
            stamp_ns=stamp, mission_id=mission, stamps_ns=np.arange(n),
            T_mission_base=np.array([pose().matrix for _ in range(n)]).reshape(n, 4, 4),
            T_mission_odom=pose(), T_map_mission=maybe(pose()),
        ),
        OccupancyGrid(
            stamp_ns=stamp, cells=rng.integers(-1, 101, (n, 3), np.int8), resolution_m=0.05, T_map_grid=pose()
        ),
        PlaneSegments(
            stamp_ns=stamp, T_base_plane=np.array([pose().matrix for _ in range(n)]).reshape(n, 4, 4),
            covariances=np.array([covariance() for _ in range(n)]).reshape(n, 6, 6),
            hulls_m=tuple(rng.random((k + 2, 2)) for k in range(n)),
            num_points=np.arange(n), rmse_m=rng.random(n), T_base_sensor=pose(),
        ),
        features, objects,
        NFrame(stamp_ns=stamp, features=(features,) * n),
        GlobalDescriptor(stamp_ns=stamp, kind="vlad", frame="camera", vector=np.ones(4, np.float32)),
    ]  # fmt: skip
