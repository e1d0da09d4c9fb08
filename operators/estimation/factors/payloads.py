"""What edges carry beyond their columns: JSON, read once for each text that occurs."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from mapstream.operators.estimation.factors.edge_ends import edge_name
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3

Payload = dict[str, Any]
_IDENTITY = np.eye(4)


def payloads(map_: Map, rows: IntArray) -> dict[int, Payload]:
    """Return the payload of each of these edges; empty where there is none.

    Raises:
        EstimationError: If one is not a JSON object.
    """
    read: dict[bytes, Payload] = {b"": {}}
    found = {}
    for row in rows.tolist():
        text = map_.edges.payload[row]
        if text not in read:
            read[text] = _parsed(map_, row, text)
        found[row] = read[text]
    return found


def _parsed(map_: Map, row: int, text: bytes) -> Payload:
    try:
        payload = json.loads(text)
    except ValueError:
        payload = None
    if not isinstance(payload, dict):
        raise EstimationError(
            f"{edge_name(map_, row)}: its payload is no JSON object: {text[:80]!r}"
        )
    return payload


def T_base_sensor_of(payload: Payload) -> FloatArray:
    """Return where the sensor sits on the base (4, 4); the identity if the payload does not say."""
    numbers = payload.get("T_base_sensor")
    return _IDENTITY if numbers is None else pose_from_numbers(numbers)


def pose_from_numbers(numbers: list[float]) -> FloatArray:
    """Return the transform (4, 4) of x, y, z [m] and a quaternion x, y, z, w.

    Raises:
        EstimationError: If they are not seven finite numbers, or the quaternion has no direction.
    """
    values = np.asarray(numbers, dtype=np.float64)
    if values.shape != (7,) or not np.isfinite(values).all() or not values[3:].any():
        raise EstimationError(
            f"a transform as [x, y, z, qx, qy, qz, qw] was expected, not {numbers}"
        )
    return SE3.from_quat_xyzw(values[3:], values[:3]).matrix


def number_of(map_: Map, row: int, payload: Payload, name: str, size: int) -> FloatArray:
    """Return the numbers (size,) under a name, which the edge's kind cannot do without.

    Raises:
        EstimationError: If they are missing, or not finite.
    """
    values = np.atleast_1d(np.asarray(payload.get(name, np.nan), dtype=np.float64))
    if values.shape != (size,) or not np.isfinite(values).all():
        raise EstimationError(
            f'{edge_name(map_, row)}: its payload needs "{name}" ({size} numbers), found {payload.get(name)}'
        )
    return values
