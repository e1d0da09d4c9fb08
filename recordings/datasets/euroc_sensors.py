"""EuRoC's `sensor.yaml` files: where a sensor sits on the body, an IMU's noise, a camera's calibration."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from mapstream.recordings.datasets.opencv_yaml import read_opencv_yaml
from mapstream.recordings.maps.ids import derived_id
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.fields import Fields
from mapstream.streams.geometry import SE3
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import CameraSensor, ImuNoise, ImuSensor, Sensor

_BODY = derived_id("sensor", "euroc", "imu0").hex()  # its frame is that of the body


def read_rig(folders: Sequence[Path]) -> tuple[Rig | None, tuple[str, ...]]:
    """Return the sensors of these folders, named for them, and what could not be used.

    Raises:
        ConfigError: If a file is wrong; the message has its line.
    """
    sensors: list[Sensor] = []
    places: list[Extrinsics] = []
    notices: list[str] = []
    for folder in folders:
        fields = read_opencv_yaml(folder / "sensor.yaml")
        kind = fields.text("sensor_type")
        if kind not in ("imu", "camera"):
            notices.append(f"{folder.name}: sensors of type {kind} are not read")
            continue
        T_base_sensor = fields.build("T_BS", partial(_place, fields))
        sensor = _imu(fields) if kind == "imu" else _camera(fields, folder.name)
        sensors.append(sensor)
        place = Extrinsics(sensor_id=sensor.id, base_sensor_id=_BODY, T_base_sensor=T_base_sensor)
        places.append(place)
    if all(sensor.id != _BODY for sensor in sensors):
        return None, (*notices, "no sensor.yaml of the IMU: places and noise are not known")
    return Rig(sensors, places), tuple(notices)


def _place(fields: Fields) -> SE3:
    return SE3(fields.matrix("T_BS", (4, 4)))


def _imu(fields: Fields) -> ImuSensor:
    noise = ImuNoise(
        gyro_density=fields.number("gyroscope_noise_density"),
        gyro_random_walk=fields.number("gyroscope_random_walk"),
        accel_density=fields.number("accelerometer_noise_density"),
        accel_random_walk=fields.number("accelerometer_random_walk"),
    )
    description = fields.text("comment", "")
    return ImuSensor(id=_BODY, topic="/imu", description=description, frame="imu", noise=noise)


def _camera(fields: Fields, name: str) -> CameraSensor:
    model, distortion = fields.text("camera_model"), fields.text("distortion_model")
    if (model, distortion) != ("pinhole", "radial-tangential"):
        raise fields.error(
            "camera_model",
            f"expected pinhole with radial-tangential, got {model} with {distortion}",
        )
    size, intrinsics = fields.vector("resolution"), fields.vector("intrinsics")
    if len(size) != 2 or len(intrinsics) != 4:
        raise fields.error("intrinsics", "expected two numbers of resolution and four intrinsics")
    calibration = CameraCalibration(
        frame=name,
        width_px=int(size[0]),
        height_px=int(size[1]),
        focal_px=intrinsics[:2],
        center_px=intrinsics[2:],
        distortion="radtan",
        distortion_parameters=fields.vector("distortion_coefficients"),
    )
    return CameraSensor(
        id=derived_id("sensor", "euroc", name).hex(),
        topic=f"/{name}/image",
        description=fields.text("comment", ""),
        frame=name,
        calibration=calibration,
    )
