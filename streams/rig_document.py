"""A rig as the plain values of a sensor file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration, RangeImageCalibration
from mapstream.streams.rig import Rig
from mapstream.streams.rig_layout import (
    COVARIANCE_KEYS,
    DISTORTIONS,
    KINDS,
    LIMIT_KEYS,
    MODELS,
    NOISE_KEYS,
    RANGE_IMAGE,
    SWAP,
)
from mapstream.streams.sensors import (
    CameraRigSensor,
    CameraSensor,
    FeatureSensor,
    ImuSensor,
    Sensor,
)

_TYPES = {kind: name for name, kind in KINDS.items()}
_MODEL_NAMES = {model: name for name, model in MODELS.items()}
_DISTORTION_NAMES = {distortion: name for name, distortion in DISTORTIONS.items()}


def rig_document(rig: Rig) -> dict[str, Any]:
    """Return what a sensor file says: two rigs with equal documents are equal."""
    document: dict[str, Any] = {"sensors": [_sensor(sensor) for sensor in rig.sensors]}
    document["extrinsics"] = [
        {
            "sensor_id": place.sensor_id,
            "base_sensor_id": place.base_sensor_id,
            "T_B_S": _matrix(place.T_base_sensor.matrix),
        }
        for place in rig.extrinsics
    ]
    document["base_frame"] = rig.base_frame
    return document


def _matrix(matrix: FloatArray) -> dict[str, Any]:
    return {"rows": matrix.shape[0], "cols": matrix.shape[1], "data": matrix.tolist()}


def _column(values: Sequence[float]) -> dict[str, Any]:
    data = list(map(float, values))
    return {"rows": len(data), "cols": 1, "data": data}


def _sensor(sensor: Sensor) -> dict[str, Any]:
    document: dict[str, Any] = {
        "id": sensor.id,
        "sensor_type": _TYPES[sensor.kind],
        "description": sensor.description,
        "topic": sensor.topic,
    }
    if sensor.frame:
        document["frame"] = sensor.frame
    if sensor.time_offset_ns:
        document["time_offset_ns"] = sensor.time_offset_ns
    if sensor.covariance is not None:
        document[COVARIANCE_KEYS[sensor.kind]] = _matrix(sensor.covariance[SWAP])
    return document | _special(sensor)


def _special(sensor: Sensor) -> dict[str, Any]:
    if isinstance(sensor, ImuSensor):
        limits = {key: getattr(sensor, name) for name, key in LIMIT_KEYS.items()}
        document = {key: limit for key, limit in limits.items() if limit is not None}
        if sensor.noise is not None:
            noise = sensor.noise
            document["sigmas"] = {key: getattr(noise, name) for name, key in NOISE_KEYS.items()}
        return document
    if isinstance(sensor, CameraSensor):
        return _calibration(sensor.calibration)
    if isinstance(sensor, CameraRigSensor):
        mounts = [
            {"camera": _sensor(mount.camera), "T_B_C": _matrix(mount.T_rig_camera.matrix)}
            for mount in sensor.mounts
        ]
        return {"cameras": mounts}
    if isinstance(sensor, FeatureSensor):
        return {"target_sensor": sensor.target_sensor_id, "feature_type": sensor.feature_type}
    return {}


def _calibration(calibration: CameraCalibration | RangeImageCalibration) -> dict[str, Any]:
    document: dict[str, Any] = {
        "image_width": calibration.width_px,
        "image_height": calibration.height_px,
        "line-delay-nanoseconds": calibration.line_delay_ns,
    }
    if isinstance(calibration, RangeImageCalibration):
        numbers = (
            calibration.horizontal_resolution_rad,
            calibration.vertical_resolution_rad,
            calibration.vertical_center_rad,
            calibration.horizontal_center_rad,
        )
        return document | {"type": RANGE_IMAGE, "intrinsics": _column(numbers)}
    xi = () if calibration.xi is None else (calibration.xi,)
    intrinsics = (*xi, *calibration.focal_px, *calibration.center_px)
    parameters = calibration.distortion_parameters.tolist()
    return document | {
        "type": _MODEL_NAMES[calibration.model],
        "intrinsics": _column(intrinsics),
        "distortion": {
            "type": _DISTORTION_NAMES[calibration.distortion],
            "parameters": _column(parameters),
        },
    }
