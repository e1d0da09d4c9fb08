"""Where sensors sit on the base: known, or variables of the problem.

A mission's `sensors` is a JSON object by name. A sensor in it whose place shall be found has
{"T_base_sensor": [x, y, z, qx, qy, qz, qw], "is_extrinsics_estimated": true}, and the measurements
that it made name it in their payload: {"sensor": NAME}.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapstream.operators.estimation.factors.payloads import Payload, T_base_sensor_of
from mapstream.operators.estimation.keys import key_of
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3

_HERE = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """Where one sensor of one mission sits."""

    mission: int
    name: str
    T_base_sensor: FloatArray  # (4, 4)
    key: int | None  # of the variable, if it is one
    description: dict[str, Any]


def sensors_of(map_: Map, mission_row: int) -> dict[str, dict[str, Any]]:
    """Return the descriptions of a mission's sensors by name.

    Raises:
        EstimationError: If they are no JSON object.
    """
    try:
        sensors = json.loads(map_.missions.sensors[mission_row] or "{}")
    except ValueError:
        sensors = None
    if not isinstance(sensors, dict):
        mission = map_.mission_id(mission_row)
        raise EstimationError(f"mission {mission}: its sensors are no JSON object")
    return {name: each for name, each in sensors.items() if isinstance(each, dict)}


def mounts(map_: Map) -> list[Mount]:
    """Return all sensors of all missions, in the order by which their keys count them."""
    found: list[Mount] = []
    for mission in range(len(map_.missions)):
        for name, description in sensors_of(map_, mission).items():
            is_variable = bool(description.get("is_extrinsics_estimated", False))
            key = key_of("extrinsics", len(found)) if is_variable else None
            found.append(Mount(mission, name, T_base_sensor_of(description), key, description))
    return found


class MountOf:
    """Finds the place of the sensor behind a measurement."""

    def __init__(self, map_: Map) -> None:
        self._missions = map_.vertices.mission
        self._by_name = {(m.mission, m.name): m for m in mounts(map_)}

    def __call__(self, vertex: int, payload: Payload) -> tuple[FloatArray, int | None]:
        """Return T_base_sensor (4, 4), and the key of the variable if it is one."""
        name = payload.get("sensor")
        mount = self._by_name.get((int(self._missions[vertex]), name)) if name else None
        if mount is None or ("T_base_sensor" in payload and mount.key is None):
            return T_base_sensor_of(payload), None
        return mount.T_base_sensor, mount.key


def with_mounts(
    map_: Map, T_base_sensor: Mapping[int, FloatArray], fix: Collection[str] = ()
) -> Map:
    """Return the map with other places (4, 4) of sensors, by the rows of `mounts`.

    With `extrinsics_rotation` or `extrinsics_translation` in `fix` that half keeps its numbers.
    """
    all_mounts = mounts(map_)
    sensors = map_.missions.sensors.copy()
    for mission in sorted({all_mounts[row].mission for row in T_base_sensor}):
        described = json.loads(sensors[mission])
        for row in _rows_of(mission, all_mounts, T_base_sensor):
            pose, description = SE3(T_base_sensor[row]), described[all_mounts[row].name]
            before = description.get("T_base_sensor", _HERE)
            t = before[:3] if "extrinsics_translation" in fix else pose.t.tolist()
            quat = before[3:] if "extrinsics_rotation" in fix else pose.quat_xyzw.tolist()
            description["T_base_sensor"] = [*t, *quat]
        sensors[mission] = json.dumps(described)
    return replace(map_, missions=replace(map_.missions, sensors=sensors))


def _rows_of(mission: int, all_mounts: list[Mount], rows: Iterable[int]) -> list[int]:
    return [row for row in rows if all_mounts[row].mission == mission]


def place_prior(mount: Mount) -> tuple[FloatArray, FloatArray]:
    """Return where a sensor is thought to sit (4, 4), and how surely: sigmas (6,), rotation first [rad, m]."""
    sigma_rad = float(mount.description.get("extrinsics_sigma_rad", 0.1))
    sigma_m = float(mount.description.get("extrinsics_sigma_m", 0.1))
    return mount.T_base_sensor, np.repeat([sigma_rad, sigma_m], 3)
