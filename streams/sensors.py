"""What a robot carries: sensors with their identity, noise and fixed covariances.

Kinds and fields follow maplab 2.0's sensor files. Covariances are (6, 6), rotation first, as everywhere
here; maplab's files put translation first, and the file reader and writer swap them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapstream.streams.arrays import FloatArray, frozen_optional
from mapstream.streams.calibration import CameraCalibration, RangeImageCalibration
from mapstream.streams.geometry import SE3

SensorKind = Literal[
    "imu",
    "lidar",
    "ncamera",
    "camera",
    "odometry",
    "wheel",
    "absolute",
    "gps_utm",
    "gps_wgs",
    "loop_closure",
    "pointcloud_map",
    "external_features",
]
_POSE_KINDS = ("odometry", "wheel", "absolute", "loop_closure", "ncamera")
_ID = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Sensor:
    """One sensor, or what counts as one, such as an odometry or a stored cloud."""

    id: str  # 32 hex digits
    kind: SensorKind
    topic: str = ""
    description: str = ""
    frame: str = ""  # its name on /tf, where it has one
    time_offset_ns: int = 0  # added to its stamps
    covariance: FloatArray | None = None  # (6, 6) of each measurement, if its messages carry none

    def __post_init__(self) -> None:
        if _ID.fullmatch(self.id) is None:
            raise ValueError(f"a sensor's id has 32 hex digits in lower case, not {self.id!r}")
        frozen_optional(self, "covariance", np.float64, (6, 6))
        covariance = self.covariance
        if covariance is not None and not (
            np.allclose(covariance, covariance.T) and np.linalg.eigvalsh(covariance).min() > 0
        ):
            raise ValueError("a covariance is symmetric and positive definite")
        if covariance is not None and self.kind not in _POSE_KINDS:
            raise ValueError(f"a sensor of kind {self.kind} has no fixed covariance of a pose")

    @property
    def node(self) -> str:
        """Its name in the tree of transforms."""
        return self.frame or self.id


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuNoise:
    """Densities of white noise and of the random walk of the biases, in continuous time."""

    gyro_density: float  # [rad/s/sqrt(Hz)]
    gyro_random_walk: float  # [rad/s^2/sqrt(Hz)]
    accel_density: float  # [m/s^2/sqrt(Hz)]
    accel_random_walk: float  # [m/s^3/sqrt(Hz)]

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} is positive, not {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True, eq=False)
class ImuSensor(Sensor):
    """An inertial measurement unit; it saturates beyond its limits."""

    kind: SensorKind = "imu"
    noise: ImuNoise | None = None
    max_accel_mps2: float | None = None
    max_gyro_radps: float | None = None
    gravity_mps2: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("max_accel_mps2", "max_gyro_radps", "gravity_mps2"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} is positive, not {value}")


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraSensor(Sensor):
    """One camera, or a LiDAR seen as one."""

    kind: SensorKind = "camera"
    calibration: CameraCalibration | RangeImageCalibration


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraMount:
    """A camera in its place on a rig of cameras."""

    camera: CameraSensor
    T_rig_camera: SE3


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraRigSensor(Sensor):
    """Cameras that take their images together."""

    kind: SensorKind = "ncamera"
    mounts: tuple[CameraMount, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureSensor(Sensor):
    """A detector outside of this program that sends features of another sensor's images."""

    kind: SensorKind = "external_features"
    target_sensor_id: str
    feature_type: str = ""
