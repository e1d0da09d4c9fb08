"""What flows between operators and what it flows through."""

from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.channel import Channel, Limits, Receiver, Sender
from mapstream.streams.clock import Clock, ReplayClock, TestClock, WallClock
from mapstream.streams.errors import MappingError
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
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.sensors import (
    CameraFrame,
    EncodedImage,
    GnssFix,
    ImuBatch,
    LaserScan2D,
    LidarScan,
    Message,
    OrganizedCloud,
    RecordRef,
    TransformBatch,
    WheelOdometry,
)
from mapstream.streams.messages.vision import ImageFeatures, NFrame
from mapstream.streams.sync import (
    anchored,
    approximate,
    cut_imu,
    exact,
    interpolate,
    latest,
    merge,
    nearest,
    window,
)
from mapstream.streams.trajectory import Trajectory

__all__ = [
    "SE3",
    "CameraCalibration",
    "CameraFrame",
    "Channel",
    "Clock",
    "Constraint",
    "EncodedImage",
    "GnssFix",
    "ImageFeatures",
    "ImuBatch",
    "Keyframe",
    "LandmarkRef",
    "LaserScan2D",
    "LidarScan",
    "Limits",
    "LoopCandidate",
    "LoopClosure",
    "LoopReport",
    "MapCorrection",
    "MapPose",
    "MappingError",
    "Message",
    "NFrame",
    "ObjectDetections",
    "Odometry",
    "OrganizedCloud",
    "OuterFrame",
    "PointCloud",
    "Receiver",
    "RecordRef",
    "RelativePose",
    "ReplayClock",
    "Sender",
    "Splice",
    "Submap",
    "TestClock",
    "Trajectory",
    "TransformBatch",
    "WallClock",
    "WheelOdometry",
    "anchored",
    "approximate",
    "cut_imu",
    "exact",
    "interpolate",
    "latest",
    "merge",
    "nearest",
    "window",
]
