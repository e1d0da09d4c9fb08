"""What a landmark of kind object says beyond its columns: extent, text, and the name that people gave it."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from mapstream.recordings.maps.tables import Landmarks
from mapstream.streams.arrays import BoolArray


def object_payload(landmarks: Landmarks, row: int) -> dict[str, Any]:
    """Return `extent_m`, `text`, `name` and whatever else a landmark says, as far as it does."""
    return payload_of(landmarks.payload[row])


def payload_of(payload: bytes) -> dict[str, Any]:
    """Return what a payload says, as `object_payload`."""
    try:
        known = json.loads(payload or b"{}")
    except ValueError:  # of another program
        return {}
    return known if isinstance(known, dict) else {}


def named(landmarks: Landmarks) -> BoolArray:
    """Return which landmarks (L,) people gave a name."""
    return np.array(
        [b'"name"' in payload and "name" in payload_of(payload) for payload in landmarks.payload],
        dtype=bool,
    )


def payload_bytes(known: dict[str, Any]) -> bytes:
    """Return these as the bytes of a payload; empty, if there are none."""
    return json.dumps(known, sort_keys=True).encode() if known else b""
