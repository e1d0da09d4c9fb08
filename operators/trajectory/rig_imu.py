"""What a sensor file says of an IMU, where the graph file says nothing."""

from __future__ import annotations

from mapstream.operators.imu.parameters import ImuParameters
from mapstream.operators.trajectory.config import ImuConfig, TrajectoryConfig
from mapstream.recordings.attached_rig import attached_rig, rig_of
from mapstream.recordings.recording import open_recording
from mapstream.streams.rig import Rig
from mapstream.streams.sensors import ImuSensor


def with_rig(config: TrajectoryConfig) -> TrajectoryConfig:
    """Return the config with the noise, limits and gravity of the rig's IMU where they were not given.

    Raises:
        ConfigError: If the sensor file is wrong, or has no such IMU.
        RecordingError: If the recording cannot be read.
    """
    if config.imu is None:
        return config
    return config.model_copy(update={"imu": described(config.imu)})


def described(config: ImuConfig) -> ImuConfig:
    """Return an IMU's config with what the rig says of it where nothing was given.

    Raises:
        ConfigError: If the sensor file is wrong, or has no such IMU.
        RecordingError: If the recording cannot be read.
    """
    sensor = _sensor(config)
    if sensor is None:
        return config
    known = ImuParameters.from_sensor(sensor)
    fresh = known.model_fields_set & ImuConfig.model_fields.keys() - config.model_fields_set
    return config.model_copy(update={name: getattr(known, name) for name in fresh})


def _sensor(config: ImuConfig) -> ImuSensor | None:
    """Return the IMU in the rig; None where there is no rig, or an attached one without IMU."""
    if config.rig is not None:
        return _selected(rig_of(config.rig), config)
    if config.recording is None:
        return None
    with open_recording(config.recording) as recording:
        rig = attached_rig(recording)
    if rig is None or all(sensor.kind != "imu" for sensor in rig.sensors):
        return None
    return _selected(rig, config)


def _selected(rig: Rig, config: ImuConfig) -> ImuSensor | None:
    sensor = rig.select("imu", config.sensor_id)
    return sensor if isinstance(sensor, ImuSensor) else None
