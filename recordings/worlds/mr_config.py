"""Options of the world W-MR."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat

from mapstream.recordings.worlds.building_tour import NUM_WAYS
from mapstream.recordings.worlds.mr_rig import RobotName
from mapstream.recordings.worlds.rgbd_camera import RgbdCameraConfig
from mapstream.recordings.worlds.satellites import SatelliteConfig
from mapstream.recordings.worlds.sensors import ImuConfig, LidarConfig
from mapstream.recordings.worlds.simulated_detector import SimulatedDetectorConfig
from mapstream.recordings.worlds.vi_rig import ViCameraConfig


class WMrConfig(BaseModel):
    """Options of W-MR."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    robot: RobotName = "camera"
    """camera: a stereo pair and an IMU, carried; rgbd: colour and depth, carried; lidar: on wheels; full: all but depth."""
    number: int = Field(default=0, ge=0, lt=NUM_WAYS)
    """Which way it goes. Neighbours share rooms, all share the corridor."""
    duration_s: PositiveFloat = Field(default=60.0, ge=2.0)
    speed_mps: PositiveFloat = 0.8
    building_seed: int = 0
    """Robots with one of these are in one building; the walls and doors of another differ, too."""
    texel_m: PositiveFloat = 0.005
    """Of the pictures on all surfaces; a coarse one is made sooner."""
    camera: ViCameraConfig = ViCameraConfig()
    rgbd: RgbdCameraConfig = RgbdCameraConfig()
    lidar: LidarConfig = LidarConfig()
    imu: ImuConfig = ImuConfig()
    wheels_hz: PositiveFloat = 50.0
    slip: NonNegativeFloat = 0.01
    """By about how much wheels count wrong, as a part of the way; aside it is twice that."""
    satellites: SatelliteConfig = SatelliteConfig(rate_hz=1.0, sigma_m=0.05)
    """Of `full`, as if the roof were of glass."""
    objects: SimulatedDetectorConfig | None = SimulatedDetectorConfig()
    """A detector behind the left camera, or the one of colour; null: none."""
    objects_hz: PositiveFloat = 10.0
    odometry_drift: NonNegativeFloat = 0.01
    """Of the topic `/odometry`, as a part of the distance."""
    delays_s: dict[str, NonNegativeFloat] = {}
    """How much later the messages of a topic become known, by its name."""
