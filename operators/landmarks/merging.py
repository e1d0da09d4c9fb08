"""Landmarks that are one and the same point, made one: within a mission and between missions.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-C (loop closure by merging landmarks).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapstream.recordings.maps.columns import BytesArray
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.object_payload import object_payload, payload_bytes, payload_of
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import MapError


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeReport:
    """What was merged."""

    num_merged: int  # landmarks that are now part of another
    num_between_missions: int  # of these, with a home in another mission


def merge_landmarks(map_: Map, pairs: IntArray) -> tuple[Map, MergeReport]:
    """Return the map in which landmarks of each pair are one; pairs of pairs are one as well.

    The first in the table stays where it is, and has the observations, tracks, descriptors and edges of all.
    It keeps the name that people gave it; if it has none, it gets that of another.
    An edge between two that are now one goes.

    Args:
        map_: The map.
        pairs: Rows of landmarks (N, 2).

    Raises:
        MapError: If a row is not one of a landmark, or two landmarks are of different kinds.
    """
    num = len(map_.landmarks)
    pairs = np.asarray(pairs, np.int64).reshape(-1, 2)
    if ((pairs < 0) | (pairs >= num)).any():
        raise MapError(f"pairs of landmarks lead to rows outside 0 to {num - 1}")
    kinds = map_.landmarks.kind[pairs]
    differ = np.flatnonzero(kinds[:, 0] != kinds[:, 1])
    if len(differ):
        a, b = pairs[differ[0]].tolist()
        raise MapError(
            f"landmarks {a} and {b} are of kinds {kinds[differ[0], 0]!r} and {kinds[differ[0], 1]!r};"
            " kinds never meet"
        )
    kept = _first_of_its_group(pairs, num)
    goes = kept != np.arange(num)
    moved = np.append(kept, -1)  # -1 stays -1
    edges = map_.edges
    a, b = moved[edges.landmark_a], moved[edges.landmark_b]
    is_loop = (a >= 0) & (a == b)
    merged = replace(
        map_,
        landmarks=replace(map_.landmarks, payload=_named(map_, kept)),
        observations=replace(map_.observations, landmark=moved[map_.observations.landmark]),
        edges=replace(edges, landmark_a=a, landmark_b=np.where(is_loop, -1, b)),
    ).select(landmarks=~goes, edges=~is_loop)
    mission = map_.vertices.mission[map_.landmarks.vertex]
    return merged, MergeReport(
        num_merged=int(goes.sum()),
        num_between_missions=int((goes & (mission != mission[kept])).sum()),
    )


def _named(map_: Map, kept: IntArray) -> BytesArray:
    """Return the payloads (L,) where the landmark that stands for each (L,) has the name of one that has a name."""
    payload = map_.landmarks.payload.copy()
    for row in np.flatnonzero(kept != np.arange(len(kept))).tolist():
        name = object_payload(map_.landmarks, row).get("name")
        known = payload_of(payload[kept[row]])
        if name and "name" not in known:
            payload[kept[row]] = payload_bytes(known | {"name": name})
    return payload


def _first_of_its_group(pairs: IntArray, num: int) -> IntArray:
    """Return for each of the landmarks (L,) the first row of those that pairs join it with."""
    from scipy.sparse import coo_array  # noqa: PLC0415  # takes most of a second to import
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(num, num))
    _, group = connected_components(links, directed=False)
    _, first = np.unique(group, return_index=True)
    found: IntArray = first[group].astype(np.int64)
    return found
