"""What a graph file says of a robot's trajectory: its sources of motion, and when poses are made."""

from __future__ import annotations

import json
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

from mapstream.operators.imu.parameters import ImuParameters, ImuQuality
from mapstream.operators.operator import OperatorConfig, OptionalPath
from mapstream.operators.trajectory.sources import AXES, AxisSigmas
from mapstream.streams.geometry import SE3

Sigma = PositiveFloat | None


class OdometryConfig(OperatorConfig):
    """A source that gets `Odometry`."""

    kind: Literal["odometry"]
    sigma_rad: PositiveFloat = 0.002
    """Uncertainty of a step where the message says nothing."""
    sigma_m: PositiveFloat = 0.01
    max_gap_s: PositiveFloat = 1.0
    """Messages further apart are not interpolated."""


class AxesConfig(OperatorConfig):
    """Standard deviations by axis; `null` leaves an axis out."""

    sigma_roll_rad: Sigma = None
    sigma_pitch_rad: Sigma = None
    sigma_yaw_rad: Sigma = None
    sigma_x_m: Sigma = None
    sigma_y_m: Sigma = None
    sigma_z_m: Sigma = None

    def sigmas(self) -> AxisSigmas:
        """Return the deviations by axis."""
        units = {"roll": "rad", "pitch": "rad", "yaw": "rad", "x": "m", "y": "m", "z": "m"}
        return {axis: getattr(self, f"sigma_{axis}_{units[axis]}") for axis in AXES}


class WheelConfig(AxesConfig):
    """A source that gets `WheelOdometry`; sigmas are those after one metre of way, and grow with its root."""

    kind: Literal["wheel"]
    sigma_yaw_rad: Sigma = 0.02
    sigma_x_m: Sigma = 0.05
    sigma_y_m: Sigma = 0.05
    turn_m_per_rad: PositiveFloat = 0.5
    """The way that a turn on the spot counts for."""
    max_gap_s: PositiveFloat = 1.0
    """Messages further apart are not interpolated."""


class StillConfig(AxesConfig):
    """A prior that nothing moves, beside the other sources; sigmas are those after one second."""

    kind: Literal["still"]


class ImuConfig(ImuQuality):
    """Noise and limits of the IMU, as the map keeps them; where it sits is taken from its samples."""

    rig: OptionalPath = None
    """A sensor file: what its IMU says of noise, limits and gravity counts where nothing is said here."""
    recording: OptionalPath = None
    """Without `rig`, the sensor file that is attached to this recording, if one is."""
    sensor_id: str | None = None
    """Which IMU of several in the sensor file."""
    max_gap_s: PositiveFloat = 0.2
    """Samples further apart are not integrated."""

    def described(self, T_base_sensor: SE3) -> dict[str, object]:
        """Return what a mission's sensor set says of the IMU."""
        place = (*T_base_sensor.t.tolist(), *T_base_sensor.quat_xyzw.tolist())
        quality = self.model_dump(include=set(ImuQuality.model_fields))
        return ImuParameters(**quality, T_base_sensor=place).description()


class MountConfig(OperatorConfig):
    """A sensor whose place on the robot an optimizer finds; its measurements name it."""

    T_base_sensor: Annotated[tuple[float, ...], Field(min_length=7, max_length=7)]
    """Where it is thought to sit: x, y, z [m] and the quaternion x, y, z, w."""
    extrinsics_sigma_rad: PositiveFloat = 0.1
    """How far it may be turned from there."""
    extrinsics_sigma_m: PositiveFloat = 0.1
    """How far it may sit from there."""


class ConstraintsConfig(OperatorConfig):
    """An input that gets `Constraint`."""

    period_s: NonNegativeFloat = 0.0
    """The first measurement in each stretch of so long is used; 0: all are."""


SourceConfig = Annotated[OdometryConfig | WheelConfig | StillConfig, Field(discriminator="kind")]


class TrajectoryConfig(OperatorConfig):
    """Options of `trajectory`: inputs are sources, names under `constraints`, `imu`, `clouds`, `n_frames`."""

    sources: dict[str, SourceConfig] = Field(default_factory=dict)
    """Sources of motion by name; the first that knows an interval gives the first guess."""
    imu: ImuConfig | None = None
    """With an IMU: an input `imu`, and its noise, which the sensor file `rig` gives, or that of `recording`."""
    constraints: dict[str, ConstraintsConfig] = Field(default_factory=dict)
    """Inputs of measurements on poses, by name."""
    mounts: dict[str, MountConfig] = Field(default_factory=dict)
    """Sensors whose place an optimizer finds, by the name that their measurements give."""
    clouds: bool = False
    """An input `clouds`: poses are made where clouds are, and keep them."""
    n_frames: bool = False
    """An input `n_frames`: poses are made where features of cameras are, and keep them."""
    num_common_tracks: int = Field(default=0, ge=-1)
    """Odometry joins two poses only if they see fewer tracks in common; 0: always, -1: never. The IMU always does."""
    bridge: Literal["none", "still", "constant_velocity"] = "still"
    """What links poses between which nothing was measured; `none` makes that an error."""
    period_s: PositiveFloat | None = 1.0
    """A pose is made at least so often, also if no measurement asks for one."""
    distance_m: PositiveFloat | None = None
    """A pose is made after so much way."""
    rotation_rad: PositiveFloat | None = None
    """A pose is made after so much of a turn."""
    window_s: NonNegativeFloat | None = 0.0
    """How late measurements are waited for; `null`: all is held until the end."""
    late_s: PositiveFloat = 30.0
    """How late a measurement may split a stretch that went out."""
    waits: bool = True
    """Inputs of measurements hold the others back, so that nothing depends on when messages arrive."""
    submap_s: PositiveFloat = 5.0
    """A submap goes out when it is so long ..."""
    num_poses: PositiveInt = 50
    """... or has so many poses."""
    without: tuple[str, ...] = ()
    """Inputs that are connected and not used, to see what each is worth: `--set trajectory.without=[planes]`."""
    mission: str = ""
    """Tells missions apart that begin at the same time; one robot needs none."""

    @model_validator(mode="after")
    def _check_names(self) -> TrajectoryConfig:
        names = [*self.sources, *self.constraints, "imu", "clouds", "n_frames"]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"two inputs are called {twice[0]}; give each a name of its own")
        if unknown := sorted(set(self.without) - set(names)):
            raise ValueError(f"without: no input {unknown[0]}; there are {', '.join(names)}")
        if taken := {"imu", "sources", "cameras"} & set(self.mounts):
            raise ValueError(f"a mount is not called {taken.pop()}: the map keeps others there")
        return self

    def described(self, T_base_imu: SE3) -> str:
        """Return the sensor set as a map's mission keeps it."""
        sensors: dict[str, object] = {
            "sources": {name: source.model_dump() for name, source in self.sources.items()}
        }
        for name, mount in self.mounts.items():
            sensors[name] = {**mount.model_dump(), "is_extrinsics_estimated": True}
        if self.imu is not None:
            sensors["imu"] = self.imu.described(T_base_imu)
        return json.dumps(sensors, sort_keys=True)
