"""The cameras of a mission, among its sensors: how each maps rays to pixels, and where it sits."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapstream.recordings.maps.model import Map
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3

_ARRAYS = ("focal_px", "center_px", "distortion_parameters")
_PLAIN = ("model", "width_px", "height_px", "xi", "distortion", "line_delay_ns")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Camera:
    """One camera of a mission."""

    calibration: CameraCalibration
    T_base_sensor: SE3


def cameras_of(map_: Map, mission_row: int) -> dict[str, Camera]:
    """Return the cameras of a mission by their names; observations name them as their sensor.

    Raises:
        MapError: If the description of one is not whole.
    """
    described = json.loads(map_.missions.sensors[mission_row]).get("cameras", {})
    try:
        return {name: _camera(name, fields) for name, fields in described.items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        mission = map_.mission_id(mission_row)
        raise MapError(f"mission {mission}: its cameras are not described: {error!r}") from error


def with_cameras(map_: Map, mission_row: int, cameras: Mapping[str, Camera]) -> Map:
    """Return the map with these cameras in a mission's sensors, in the place of those of their names."""
    sensors = json.loads(map_.missions.sensors[mission_row])
    new = {name: _described(camera) for name, camera in cameras.items()}
    sensors["cameras"] = dict(sorted({**sensors.get("cameras", {}), **new}.items()))
    texts = map_.missions.sensors.copy()
    texts[mission_row] = json.dumps(sensors, sort_keys=True)
    return replace(map_, missions=replace(map_.missions, sensors=texts))


def _described(camera: Camera) -> dict[str, Any]:
    calibration, place = camera.calibration, camera.T_base_sensor
    fields = {name: getattr(calibration, name) for name in _PLAIN}
    fields |= {name: getattr(calibration, name).tolist() for name in _ARRAYS}
    return {**fields, "T_base_sensor": [*place.t.tolist(), *place.quat_xyzw.tolist()]}


def _camera(name: str, fields: Mapping[str, Any]) -> Camera:
    arrays: dict[str, Any] = {key: np.array(fields[key], dtype=np.float64) for key in _ARRAYS}
    plain: dict[str, Any] = {key: fields[key] for key in _PLAIN}
    place = np.array(fields["T_base_sensor"], dtype=np.float64)
    return Camera(
        calibration=CameraCalibration(frame=name, **plain, **arrays),
        T_base_sensor=SE3.from_quat_xyzw(place[3:], place[:3]),
    )
