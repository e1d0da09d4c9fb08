"""What measurements of objects say of them besides their place, as their landmarks keep it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.object_payload import object_payload, payload_bytes, payload_of
from mapstream.streams.arrays import IntArray


def with_facts_of(map_: Map, edges: IntArray) -> Map:
    """Return the map whose landmarks know what these edges (rows) say of them: extent and text.

    An extent is the median of all that measurements say. A hull is not a fact of this kind, see `plane_hulls`.
    """
    new = [row for row in edges.tolist() if _facts(map_, row)]
    touched = np.unique(map_.edges.landmark_a[new])
    if not len(touched):
        return map_
    said: dict[int, list[dict[str, Any]]] = {}
    for row in np.flatnonzero(np.isin(map_.edges.landmark_a, touched)).tolist():
        said.setdefault(int(map_.edges.landmark_a[row]), []).append(_facts(map_, row))
    payload = map_.landmarks.payload.copy()
    for landmark, facts in said.items():
        known = object_payload(map_.landmarks, landmark)
        extents_m = [fact["extent_m"] for fact in facts if "extent_m" in fact]
        if extents_m:
            known["extent_m"] = np.median(extents_m, axis=0).round(4).tolist()
        texts = [fact["text"] for fact in facts if "text" in fact]
        if texts:
            known["text"] = texts[0]
        payload[landmark] = payload_bytes(known)
    return replace(map_, landmarks=replace(map_.landmarks, payload=payload))


def _facts(map_: Map, edge: int) -> dict[str, Any]:
    """Return the extent and the text that a measurement of a landmark gives."""
    given = payload_of(map_.edges.payload[edge]) if map_.edges.landmark_a[edge] >= 0 else {}
    facts: dict[str, Any] = {}
    if isinstance(given.get("text"), str):
        facts["text"] = given["text"]
    extent_m = given.get("extent_m")
    if isinstance(extent_m, list) and np.shape(extent_m) == (3,):
        facts["extent_m"] = extent_m
    return facts
