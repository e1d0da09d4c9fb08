"""Sensor files in maplab 2.0's YAML layout: `sensors` and `extrinsics`.

Three keys are ours: `frame` and `time_offset_ns` of a sensor, and `base_frame` of the whole.
maplab's covariances have translation first; here rotation comes first, so the blocks are swapped.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from ruamel.yaml import YAML

from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration, Distortion, RangeImageCalibration
from mapstream.streams.errors import ConfigError, TransformError
from mapstream.streams.fields import Fields
from mapstream.streams.geometry import SE3
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.rig_document import rig_document
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
    CameraMount,
    CameraRigSensor,
    CameraSensor,
    FeatureSensor,
    ImuNoise,
    ImuSensor,
    Sensor,
    SensorKind,
)

C = TypeVar("C")
_log = logging.getLogger(__name__)


def load_rig(path: Path) -> Rig:
    """Read a sensor file. Keys that mean nothing here are named in the log.

    Raises:
        ConfigError: If the file is unreadable or wrong; the message has the file, the line, the key.
    """
    return _rig_of(Fields.of_file(path), path)


def parse_rig(content: bytes, path: Path) -> Rig:
    """Read the bytes of a sensor file; the path is for messages.

    Raises:
        ConfigError: If they are wrong; the message has the path, the line, the key.
    """
    return _rig_of(Fields.of_bytes(content, path), path)


def _rig_of(top: Fields, path: Path) -> Rig:
    sensors = [_sensor(fields) for fields in top.items("sensors")]
    extrinsics = []
    for fields in top.items("extrinsics"):
        place = Extrinsics(
            sensor_id=fields.text("sensor_id"),
            base_sensor_id=fields.text("base_sensor_id"),
            T_base_sensor=_transform(fields, "T_B_S"),
        )
        extrinsics.append(place)
        _warn_of_unread(fields)
    base_frame = top.text("base_frame", "")
    _warn_of_unread(top)
    try:
        return Rig(sensors, extrinsics, base_frame)
    except (ConfigError, TransformError) as error:
        raise ConfigError(f"{path}: {error}") from error


def write_rig(rig: Rig, path: Path) -> None:
    """Write a sensor file that loads equal, replacing an older one at once.

    Raises:
        OSError: If it cannot be written; an older file is then left as it was.
    """
    partial = path.with_name(f".{path.name}.partial")
    partial.write_bytes(format_rig(rig))
    partial.replace(path)


def format_rig(rig: Rig) -> bytes:
    """Return the content of a sensor file that loads equal."""
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # its stub says None
    content = BytesIO()
    yaml.dump(rig_document(rig), content)
    return content.getvalue()


def _warn_of_unread(fields: Fields) -> None:
    for place in fields.unread():
        _log.warning("%s means nothing here and is ignored", place)


def _transform(fields: Fields, key: str) -> SE3:
    matrix = fields.matrix(key, (4, 4))
    return fields.build(key, lambda: SE3(matrix))


def _choice(fields: Fields, key: str, choices: Mapping[str, C], default: str | None = None) -> C:
    name = fields.text(key, default)
    if name not in choices:
        raise fields.error(key, f"{name!r} is none of {', '.join(choices)}")
    return choices[name]


def _sensor(fields: Fields, default_type: str | None = None) -> Sensor:
    kind: SensorKind = _choice(fields, "sensor_type", KINDS, default_type)
    common: dict[str, Any] = {
        "id": fields.text("id"),
        "kind": kind,
        "topic": fields.text("topic", ""),
        "description": fields.text("description", ""),
        "frame": fields.text("frame", ""),
        "time_offset_ns": fields.integer("time_offset_ns", 0),
    }
    covariance_key = COVARIANCE_KEYS.get(kind)
    if covariance_key is not None and covariance_key in fields:
        common["covariance"] = fields.matrix(covariance_key, (6, 6))[SWAP]
    sensor_type, special = _special(fields, kind)
    sensor = fields.build("id", lambda: sensor_type(**common, **special))
    _warn_of_unread(fields)
    return sensor


def _special(fields: Fields, kind: SensorKind) -> tuple[type[Sensor], dict[str, Any]]:
    """Return the class of a sensor and what only that class has."""
    if kind == "imu":
        limits = {name: fields.optional_number(key) for name, key in LIMIT_KEYS.items()}
        return ImuSensor, {"noise": _noise(fields), **limits}
    if kind == "camera":
        return CameraSensor, {"calibration": _calibration(fields)}
    if kind == "ncamera":
        return CameraRigSensor, {"mounts": tuple(map(_mount, fields.items("cameras")))}
    if kind == "external_features":
        feature_type = fields.text("feature_type", "")
        return FeatureSensor, {
            "target_sensor_id": fields.text("target_sensor"),
            "feature_type": feature_type,
        }
    return Sensor, {}


def _noise(fields: Fields) -> ImuNoise | None:
    if "sigmas" not in fields:
        return None
    sigmas = fields.mapping("sigmas")
    densities = {name: sigmas.number(key) for name, key in NOISE_KEYS.items()}
    _warn_of_unread(sigmas)
    return fields.build("sigmas", lambda: ImuNoise(**densities))


def _mount(fields: Fields) -> CameraMount:
    camera = _sensor(fields.mapping("camera"), "CAMERA")
    if not isinstance(camera, CameraSensor):
        raise fields.error("camera", f"expected a CAMERA, got the {camera.kind} {camera.id}")
    mount = CameraMount(camera=camera, T_rig_camera=_transform(fields, "T_B_C"))
    _warn_of_unread(fields)
    return mount


def _calibration(fields: Fields) -> CameraCalibration | RangeImageCalibration:
    width_px, height_px = fields.integer("image_width"), fields.integer("image_height")
    line_delay_ns = fields.integer("line-delay-nanoseconds", 0)
    intrinsics = fields.vector("intrinsics").tolist()
    if fields.text("type") == RANGE_IMAGE:
        if len(intrinsics) != 4:
            raise fields.error("intrinsics", f"expected 4 numbers, got {len(intrinsics)}")
        return RangeImageCalibration(
            width_px=width_px,
            height_px=height_px,
            horizontal_resolution_rad=intrinsics[0],
            vertical_resolution_rad=intrinsics[1],
            vertical_center_rad=intrinsics[2],
            horizontal_center_rad=intrinsics[3],
            line_delay_ns=line_delay_ns,
        )
    model = _choice(fields, "type", MODELS)
    xi = [intrinsics.pop(0)] if model == "unified" and intrinsics else [None]
    distortion, parameters = _distortion(fields)
    return fields.build(
        "intrinsics",
        lambda: CameraCalibration(
            frame=fields.text("frame", fields.text("id")),
            model=model,
            width_px=width_px,
            height_px=height_px,
            focal_px=np.array(intrinsics[:2]),
            center_px=np.array(intrinsics[2:]),
            xi=xi[0],
            distortion=distortion,
            distortion_parameters=parameters,
            line_delay_ns=line_delay_ns,
        ),
    )


def _distortion(fields: Fields) -> tuple[Distortion, FloatArray]:
    if "distortion" not in fields:
        return "none", np.zeros(0)
    distortion = fields.mapping("distortion")
    kind = _choice(distortion, "type", DISTORTIONS)
    parameters = distortion.vector("parameters") if "parameters" in distortion else np.zeros(0)
    _warn_of_unread(distortion)
    return kind, parameters
