"""Where the sensors of missions sit, as observations name them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from mapstream.recordings.maps.cameras import Camera, cameras_of
from mapstream.recordings.maps.columns import TextArray
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3

_IMU = "imu"


def all_cameras(map_: Map) -> dict[tuple[int, str], Camera]:
    """Return the cameras of all missions, by the mission's row and their name, in this order.

    Raises:
        MapError: If the description of one is not whole.
    """
    return {
        (mission, name): camera
        for mission in range(len(map_.missions))
        for name, camera in sorted(cameras_of(map_, mission).items())
    }


def T_base_of_imu(map_: Map, mission_row: int) -> FloatArray:
    """Return where the IMU of a mission sits (4, 4); at the base where the mission does not say."""
    described = json.loads(map_.missions.sensors[mission_row]).get(_IMU, {})
    return _place(described)


def T_base_sensor_of(map_: Map, rows: IntArray) -> FloatArray:
    """Return where the sensors of observations sit (N, 4, 4); at the base where their mission does not say."""
    sensors, at = sensors_of(map_, rows)
    cameras = all_cameras(map_)
    described = [json.loads(text) for text in map_.missions.sensors]
    places = [
        cameras[each].T_base_sensor.matrix
        if each in cameras
        else _place(described[each[0]].get(each[1], {}))
        for each in sensors
    ]
    found: FloatArray = np.array(places).reshape(-1, 4, 4)[at]
    return found


def sensors_of(map_: Map, rows: IntArray) -> tuple[list[tuple[int, str]], IntArray]:
    """Return the sensors, by mission and name, that made observations; and which of these each (N,) has."""
    seen = map_.observations
    numbers, names = numbered(seen.sensor[rows])
    mission = map_.vertices.mission[seen.vertex[rows]]
    codes, at = np.unique(mission * max(len(names), 1) + numbers, return_inverse=True)
    pairs = [divmod(code, max(len(names), 1)) for code in codes.tolist()]
    return [(mission, names[name]) for mission, name in pairs], at.astype(np.int64)


def numbered(texts: TextArray) -> tuple[IntArray, list[str]]:
    """Return a number (N,) for each text, and the texts by number; faster than sorting objects."""
    number_of: dict[str, int] = {}
    numbers = [number_of.setdefault(text, len(number_of)) for text in texts.tolist()]
    return np.array(numbers, dtype=np.int64), list(number_of)


def _place(described: Any) -> FloatArray:  # noqa: ANN401  # JSON
    numbers = described.get("T_base_sensor") if isinstance(described, dict) else None
    if numbers is None:
        return np.eye(4)
    return SE3.from_quat_xyzw(numbers[3:], numbers[:3]).matrix
