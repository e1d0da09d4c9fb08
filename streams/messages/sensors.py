"""What sensors say.

Every message has `stamp_ns`: when its content was true, in integer nanoseconds.
`frame` names the sensor. `T_base_sensor` is where the sensor sat on the robot at that time; a sensor
whose place nobody described is itself the base, and the transform is the identity.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import (
    Float32Array,
    FloatArray,
    IntArray,
    frozen,
    frozen_optional,
)
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3


class Message(Protocol):
    """Anything that can flow: it knows when it was true."""

    @property
    def stamp_ns(self) -> int: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordRef:
    """Where a message lies in a recording, so that it can be read again and need not be kept."""

    path: str
    topic: str
    log_ns: int  # log time of the message, which the recording's index finds


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LidarScan:
    """One sweep or packet group of a LiDAR, in the sensor's frame."""

    stamp_ns: int  # the time that offsets_ns count from
    points: Float32Array  # (N, 3) [m]; all finite
    intensity: Float32Array | None = None  # (N,) as the sensor gives it
    ring: npt.NDArray[np.uint16] | None = None  # (N,) beam number
    offsets_ns: IntArray | None = None  # (N,) time of each point after stamp_ns, may be negative
    frame: str = "lidar"
    T_base_sensor: SE3 = field(default_factory=SE3.identity)
    record: RecordRef | None = None

    def __post_init__(self) -> None:
        n = frozen(self, "points", np.float32, (None, 3)).shape[0]
        frozen_optional(self, "intensity", np.float32, (n,))
        frozen_optional(self, "ring", np.uint16, (n,))
        frozen_optional(self, "offsets_ns", np.int64, (n,))

    @property
    def end_ns(self) -> int:
        """Time of the last point; the stamp itself where points carry no time."""
        timed = self.offsets_ns is not None and self.offsets_ns.size
        return self.stamp_ns + (int(self.offsets_ns.max()) if timed else 0)  # type: ignore[union-attr]  # timed implies it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraFrame:
    """One decoded image."""

    stamp_ns: int
    image: npt.NDArray[Any]  # (H, W) or (H, W, 3); uint8, uint16 or float32
    encoding: str  # as in ROS: mono8, bgr8, rgb8, mono16, 16UC1 [mm], 32FC1 [m]
    frame: str = "camera"
    T_base_sensor: SE3 = field(default_factory=SE3.identity)
    camera: CameraCalibration | None = None  # where a rig's file or a topic described it
    record: RecordRef | None = None

    def __post_init__(self) -> None:
        color = self.encoding in ("bgr8", "rgb8")
        frozen(self, "image", self.image.dtype, (None, None, 3) if color else (None, None))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OrganizedCloud:
    """The points that the pixels of a depth camera see, row by row, in the camera's frame."""

    stamp_ns: int
    points: Float32Array  # (H, W, 3) [m]; nan where nothing was seen
    colors_rgb: npt.NDArray[np.uint8] | None = None  # (H, W, 3)
    frame: str = "camera"
    T_base_sensor: SE3 = field(default_factory=SE3.identity)
    record: RecordRef | None = None

    def __post_init__(self) -> None:
        height, width, _ = frozen(self, "points", np.float32, (None, None, 3)).shape
        frozen_optional(self, "colors_rgb", np.uint8, (height, width, 3))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EncodedImage:
    """One compressed image, as recorded."""

    stamp_ns: int
    data: npt.NDArray[np.uint8]  # (N,) the file's bytes
    format: str  # jpeg, png, ...
    frame: str = "camera"
    T_base_sensor: SE3 = field(default_factory=SE3.identity)
    camera: CameraCalibration | None = None  # where a rig's file or a topic described it
    record: RecordRef | None = None

    def __post_init__(self) -> None:
        frozen(self, "data", np.uint8, (None,))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuBatch:
    """Consecutive IMU samples; high-rate topics travel in batches, never one by one."""

    stamps_ns: IntArray  # (N,) not decreasing, N >= 1
    gyro_radps: FloatArray  # (N, 3)
    accel_mps2: FloatArray  # (N, 3) specific force: +g along "up" at rest
    is_saturated: npt.NDArray[np.bool_] | None = None  # (N,)
    frame: str = "imu"
    T_base_sensor: SE3 = field(default_factory=SE3.identity)

    def __post_init__(self) -> None:
        n = frozen(self, "stamps_ns", np.int64, (None,)).shape[0]
        if n == 0:
            raise ValueError("ImuBatch: no samples")
        frozen(self, "gyro_radps", np.float64, (n, 3))
        frozen(self, "accel_mps2", np.float64, (n, 3))
        frozen_optional(self, "is_saturated", np.bool_, (n,))

    @property
    def stamp_ns(self) -> int:
        return int(self.stamps_ns[-1])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaserScan2D:
    """One sweep of a planar laser: beam i points to angle_min_rad + i * angle_step_rad."""

    stamp_ns: int  # time of the first beam
    ranges_m: Float32Array  # (N,) nan where nothing was seen
    angle_min_rad: float
    angle_step_rad: float
    range_min_m: float
    range_max_m: float
    beam_period_ns: int = 0  # between neighbouring beams
    intensity: Float32Array | None = None  # (N,)
    frame: str = "laser"
    T_base_sensor: SE3 = field(default_factory=SE3.identity)
    record: RecordRef | None = None

    def __post_init__(self) -> None:
        n = frozen(self, "ranges_m", np.float32, (None,)).shape[0]
        frozen_optional(self, "intensity", np.float32, (n,))

    @property
    def end_ns(self) -> int:
        """Time of the last beam."""
        return self.stamp_ns + max(len(self.ranges_m) - 1, 0) * self.beam_period_ns


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GnssFix:
    """One satellite fix on the WGS84 ellipsoid."""

    stamp_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float  # above the ellipsoid
    covariance_enu_m2: FloatArray | None = None  # (3, 3) east, north, up
    frame: str = "gnss"
    T_base_sensor: SE3 = field(default_factory=SE3.identity)

    def __post_init__(self) -> None:
        frozen_optional(self, "covariance_enu_m2", np.float64, (3, 3))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WheelOdometry:
    """Pose from wheel encoders; z, roll and pitch are not observed."""

    stamp_ns: int
    T_odom_base: SE3
    covariance: FloatArray | None = None  # (6, 6) of the pose, rotation first
    frame: str = "odom"

    def __post_init__(self) -> None:
        frozen_optional(self, "covariance", np.float64, (6, 6))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TransformBatch:
    """Transforms between named frames, as on `/tf` and `/tf_static`."""

    stamps_ns: IntArray  # (N,)
    parents: tuple[str, ...]
    children: tuple[str, ...]
    T_parent_child: FloatArray  # (N, 4, 4)
    is_static: bool = False

    def __post_init__(self) -> None:
        n = frozen(self, "stamps_ns", np.int64, (None,)).shape[0]
        frozen(self, "T_parent_child", np.float64, (n, 4, 4))
        if not n == len(self.parents) == len(self.children) or n == 0:
            raise ValueError(f"TransformBatch: {n} transforms of {len(self.children)} frames")

    @property
    def stamp_ns(self) -> int:
        return int(self.stamps_ns[-1])
