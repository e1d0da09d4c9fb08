"""Names that people give to landmarks: "kitchen table", "my cup"."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapstream.operators.maps.words import matches
from mapstream.recordings.maps.hulls import area_of, hull_of
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.object_payload import named, object_payload, payload_bytes
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import invert

_LEAST_DIGITS = 4  # of an id


@dataclass(frozen=True, slots=True, kw_only=True)
class Naming:
    """What was named, or lost its name."""

    landmark: str  # its id
    kind: str
    label: str  # its class
    name: str  # that it has now; empty: none
    was: str  # that it had


def name_landmark(map_: Map, row: int, name: str) -> tuple[Map, Naming]:
    """Return the map in which a landmark has a name; an empty one takes its name away.

    Raises:
        MapError: If another program keeps something in the landmark's payload that is no JSON.
    """
    landmarks = map_.landmarks
    if landmarks.payload[row] and not _is_json(landmarks.payload[row]):
        raise MapError(
            f"landmark {_id(map_, row)} of kind {landmarks.kind[row]} cannot have a name: its payload is"
            " that of another program"
        )
    known = object_payload(landmarks, row)
    was = str(known.pop("name", ""))
    payload = landmarks.payload.copy()
    payload[row] = payload_bytes(known | ({"name": name} if name else {}))
    naming = Naming(
        landmark=_id(map_, row),
        kind=landmarks.kind[row],
        label=landmarks.label[row],
        name=name,
        was=was,
    )
    return replace(map_, landmarks=replace(landmarks, payload=payload)), naming


def find_landmark(
    map_: Map, text: str, near: FloatArray | None = None, within_m: float = 1.0
) -> int:
    """Return the row of the landmark that people mean.

    Args:
        map_: The map.
        text: First digits of its id (four or more), its class, name, text or kind; or empty.
        near: A point (3,) of the map frame [m]; without a text, the nearest object or plane is meant.
        within_m: So far it may be from there.

    Raises:
        MapError: If there is none, or there are several.
    """
    rows = _called(map_, text) if text else things(map_)
    if not len(rows):
        raise MapError(f"no landmark is called {text!r}; the map has {known_words(map_)}")
    if near is None and len(rows) == 1:
        return int(rows[0])
    if near is None:
        raise MapError(
            f"{len(rows)} landmarks are called {text!r}: say near which x,y,z it is, or one of the ids"
            f" {', '.join(_id(map_, row)[:8] for row in rows[:8].tolist())}"
        )
    away_m = np.array([distance_m(map_, row, near) for row in rows.tolist()])
    if not away_m.min(initial=np.inf) <= within_m:
        raise MapError(
            f"no {text or 'object or plane'} within {within_m:g} m of {near.tolist()}: the nearest is"
            f" {away_m.min(initial=np.inf):.2f} m away"
        )
    return int(rows[away_m.argmin()])


def distance_m(map_: Map, row: int, p_map: FloatArray) -> float:
    """Return how far a point (3,) of the map frame is from a landmark: from the outline of a plane, else its middle."""
    T_landmark_map = invert(map_.T_map_landmark(np.array([row]))[0])
    p = T_landmark_map[:3, :3] @ p_map + T_landmark_map[:3, 3]
    hull = hull_of(map_.landmarks.payload[row])
    if area_of(hull) == 0:
        return float(np.linalg.norm(p))
    return float(np.hypot(_outside_m(hull, p[:2]), p[2]))


def _outside_m(hull: FloatArray, p: FloatArray) -> float:
    """Return how far a point (2,) is outside a convex hull (K, 2); 0 inside."""
    sides = np.roll(hull, -1, axis=0) - hull
    cross = sides[:, 0] * (p[1] - hull[:, 1]) - sides[:, 1] * (p[0] - hull[:, 0])
    if (cross >= 0).all() or (cross <= 0).all():
        return 0.0
    along = np.einsum("ij,ij->i", p - hull, sides) / np.einsum("ij,ij->i", sides, sides)
    nearest = hull + np.clip(along, 0, 1)[:, None] * sides
    return float(np.linalg.norm(nearest - p, axis=1).min())


def words_of(map_: Map, row: int) -> tuple[str, ...]:
    """Return by what a landmark is known: its name, class, text and kind."""
    known = object_payload(map_.landmarks, row)
    table = map_.landmarks
    return (
        str(known.get("name", "")), table.label[row], str(known.get("text", "")), table.kind[row]
    )  # fmt: skip


def _called(map_: Map, text: str) -> IntArray:
    ids = [_id(map_, row) for row in range(len(map_.landmarks))]
    if len(text) >= _LEAST_DIGITS:
        rows = [row for row, digits in enumerate(ids) if digits.startswith(text.lower())]
        if len(rows) == 1:
            return np.array(rows)
    rows = [row for row in things(map_).tolist() if matches(text, words_of(map_, row))]
    return np.array(rows, np.int64)


def things(map_: Map) -> IntArray:
    """Return the landmarks (rows) that people may mean: those with a class, a name or an outline."""
    landmarks = map_.landmarks
    is_thing = (landmarks.label != "") | np.isin(landmarks.kind, ("object", "plane", "pose"))
    return np.flatnonzero(is_thing | named(landmarks))


def known_words(map_: Map) -> str:
    """Return which classes of landmarks there are, for people."""
    rows = things(map_)
    labels = [map_.landmarks.label[row] or map_.landmarks.kind[row] for row in rows.tolist()]
    return ", ".join(sorted(set(labels))) or "no objects and no planes"


def _id(map_: Map, row: int) -> str:
    return bytes(map_.landmarks.id[row]).hex()


def _is_json(payload: bytes) -> bool:
    try:
        found: Any = json.loads(payload)
    except ValueError:
        return False
    return isinstance(found, dict)
