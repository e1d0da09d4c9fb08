"""The sensors of the world W-VI: where they sit, how the cameras see, and what the recording says of it."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat

from mapstream.recordings.worlds.satellites import T_BASE_ANTENNA
from mapstream.recordings.worlds.sensors import ImuConfig
from mapstream.recordings.worlds.truth import sensor_id
from mapstream.streams.calibration import CameraCalibration, CameraModel, Distortion
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import (
    CameraMount,
    CameraRigSensor,
    CameraSensor,
    Sensor,
)

CameraName = Literal["front_left", "front_right", "left", "right", "rear"]
LensName = Literal["none", "radtan", "rational", "equidistant", "fov", "unified"]
BASE = "base"
# Turned and off the middle, so that a forgotten extrinsic shows.
T_BASE_IMU = SE3.from_rotation(so3_exp([0.02, -0.03, 0.5]), [0.04, -0.02, 0.03])


def _place(t: tuple[float, float, float], yaw_deg: float, bend: tuple[float, float, float]) -> SE3:
    ahead = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # the camera's z is the base's x
    yaw = so3_exp([0, 0, np.radians(yaw_deg)])
    return SE3.from_rotation(yaw @ so3_exp([0, 0.08, 0]) @ ahead @ so3_exp(bend), t)


T_BASE_CAMERA: dict[CameraName, SE3] = {
    "front_left": _place((0.12, 0.08, 0.02), 0, (0.004, -0.006, 0.003)),
    "front_right": _place((0.12, -0.08, 0.02), 0, (-0.003, 0.005, -0.006)),
    "left": _place((0.02, 0.12, 0.03), 90, (0.01, 0.004, -0.008)),
    "right": _place((0.01, -0.12, 0.03), -90, (-0.007, 0.009, 0.005)),
    "rear": _place((-0.12, 0.01, 0.02), 180, (0.006, -0.01, 0.004)),
}
_LENSES: dict[LensName, tuple[CameraModel, Distortion, list[float]]] = {
    "none": ("pinhole", "none", []),
    "radtan": ("pinhole", "radtan", [-0.12, 0.03, 3e-4, -2e-4]),
    "rational": (
        "pinhole",
        "rational_polynomial",
        [0.4, 0.05, 3e-4, -2e-4, 0.002, 0.5, 0.12, 0.01],
    ),
    "equidistant": ("pinhole", "equidistant", [-0.013, 0.009, -0.007, 0.002]),
    "fov": ("pinhole", "fov", [0.9]),
    "unified": ("unified", "radtan", [-0.10, 0.02, 2e-4, -1e-4]),
}
_UNIFIED_XI = 0.8


class Blindness(BaseModel):
    """A time in which cameras see nothing."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    start_s: NonNegativeFloat
    end_s: PositiveFloat
    kind: Literal["black", "blank"] = "black"
    """`blank`: a wall without texture fills the view."""
    cameras: tuple[CameraName, ...] = tuple(T_BASE_CAMERA)


class ViCameraConfig(BaseModel):
    """All cameras of the robot; they take their images at one time."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    width_px: int = Field(default=640, ge=32)
    height_px: int = Field(default=480, ge=24)
    focal_px: PositiveFloat | None = None
    """In the middle of the image; 5/8 of the width where nothing is said: 77 degrees."""
    lens: LensName = "radtan"
    rate_hz: PositiveFloat = 20.0
    readout_s: float = Field(default=0.0, ge=0, le=0.1)
    """Of a rolling shutter, from the first row to the last; an image's stamp is that of its first row."""
    exposure_s: float = Field(default=0.0, ge=0, le=0.1)
    """Motion blur: the mean of `blur_samples` moments around the stamp."""
    blur_samples: int = Field(default=5, ge=2)
    noise: NonNegativeFloat = 2.0
    """Standard deviation [grey levels]."""
    format: Literal["jpeg", "png"] = "jpeg"
    quality: int = Field(default=85, ge=1, le=100)
    """Of JPEG."""
    time_offset_s: float = 0.0
    """Added to the stamps of all images, which nobody is told."""
    rig_error_rad: NonNegativeFloat = 0.0
    """By how much the attached rig's places of the cameras are turned wrong, each about an axis of its own."""
    rig_error_m: NonNegativeFloat = 0.0
    blindness: tuple[Blindness, ...] = ()

    def blindness_of(
        self, name: CameraName, since_start_s: float
    ) -> Literal["black", "blank"] | None:
        """Return what a camera shows instead of the world at a time; None if it sees."""
        for time in self.blindness:
            if name in time.cameras and time.start_s <= since_start_s < time.end_s:
                return time.kind
        return None

    def calibration(self, name: CameraName) -> CameraCalibration:
        """Return how a camera sees; no two are quite the same."""
        model, distortion, parameters = _LENSES[self.lens]
        number = list(T_BASE_CAMERA).index(name)
        focal = (self.focal_px or 0.625 * self.width_px) * (1 + 0.004 * number)
        xi = _UNIFIED_XI if model == "unified" else None
        center = (np.array([self.width_px, self.height_px]) - 1) / 2
        return CameraCalibration(
            frame=name,
            model=model,
            width_px=self.width_px,
            height_px=self.height_px,
            focal_px=focal * (1 + (xi or 0.0)) * np.array([1.0, 1.001]),
            center_px=center + np.array([1.5 - number, 0.7 * number - 1]),
            xi=xi,
            distortion=distortion,
            distortion_parameters=np.array(parameters),
            line_delay_ns=round(self.readout_s * 1e9 / self.height_px),
        )


def claimed_places(
    config: ViCameraConfig, cameras: tuple[CameraName, ...], rng: np.random.Generator
) -> dict[CameraName, SE3]:
    """Return where the rig says that cameras sit, with the errors that the config asks for."""
    places = {}
    for name in cameras:
        directions = rng.normal(0, 1, (2, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        error = directions * [[config.rig_error_rad], [config.rig_error_m]]
        places[name] = T_BASE_CAMERA[name] @ SE3.exp(error.ravel())
    return places


def vi_rig(config: ViCameraConfig, places: dict[CameraName, SE3], imu: ImuConfig) -> Rig:
    """Return what the recording says of its sensors. The odometry's sensor is the base."""
    odometry = Sensor(id=sensor_id(BASE), kind="odometry", topic="/odometry", frame=BASE)
    inertial = imu.sensor(sensor_id("imu"))
    satellites = Sensor(id=sensor_id("gnss"), kind="gps_wgs", topic="/gnss", frame="gnss")
    mounts = tuple(
        CameraMount(
            camera=CameraSensor(
                id=sensor_id(name),
                topic=f"/{name}/image",
                frame=name,
                calibration=config.calibration(name),
            ),
            T_rig_camera=place,
        )
        for name, place in places.items()
    )
    cameras = CameraRigSensor(id=sensor_id("cameras"), frame="cameras", mounts=mounts)
    sensors = (odometry, inertial, satellites, cameras)
    hangs = (SE3.identity(), T_BASE_IMU, T_BASE_ANTENNA, SE3.identity())
    extrinsics = [
        Extrinsics(sensor_id=sensor.id, base_sensor_id=odometry.id, T_base_sensor=place)
        for sensor, place in zip(sensors, hangs, strict=True)
    ]
    return Rig(sensors, extrinsics, base_frame=BASE)
