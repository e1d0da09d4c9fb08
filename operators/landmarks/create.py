"""Landmarks from tracks that have none yet, and the places of those that are there.

Keypoints of one mission, kind and track are of one point, over all cameras.
Source: maplab's commands init_track_landmarks (itl) and retriangulate_landmarks (rtl).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapstream.operators.landmarks.locating import FOUND, LocateConfig, Located, locate
from mapstream.operators.landmarks.sensors import numbered
from mapstream.recordings.maps.columns import TextArray
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Landmarks
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.geometry import invert


@dataclass(frozen=True, slots=True, kw_only=True)
class LocateReport:
    """How many points were found, and why others were not."""

    num_found: int
    not_found: dict[str, int]  # by reason


def create_landmarks(map_: Map, config: LocateConfig | None = None) -> tuple[Map, LocateReport]:
    """Return the map with a landmark for each track that has none and whose observations determine a point."""
    config = config or LocateConfig()
    rows, group = _left_over(map_)
    located = locate(map_, rows, group, config)
    is_found = located.outcome == FOUND
    first = np.flatnonzero(np.append(True, group[1:] != group[:-1])) if len(group) else group
    first_rows = rows[first]
    added = _landmarks(map_, first_rows[is_found], located, is_found)
    added = replace(added, label=_labels(map_, rows, group)[is_found])
    number = np.cumsum(is_found) - 1 + len(map_.landmarks)
    landmark = map_.observations.landmark.copy()
    landmark[rows] = np.where(is_found[group], number[group], -1)
    made = replace(
        map_,
        landmarks=concatenate([map_.landmarks, added]),
        observations=replace(map_.observations, landmark=landmark),
    )
    return made, _report(located)


def retriangulate(map_: Map, config: LocateConfig | None = None) -> tuple[Map, LocateReport]:
    """Return the map with every point where its observations see it from the poses of now.

    Points that observations do not determine any more stay with their vertex, and are counted.
    """
    config = config or LocateConfig()
    seen = map_.observations.landmark
    rows = np.flatnonzero(seen >= 0)
    rows = rows[np.argsort(seen[rows], kind="stable")]
    landmarks, group = np.unique(seen[rows], return_inverse=True)
    located = locate(map_, rows, group, config)
    is_found = located.outcome == FOUND
    return with_positions(map_, landmarks[is_found], located, is_found), _report(located)


def with_positions(map_: Map, rows: IntArray, located: Located, chosen: BoolArray) -> Map:
    """Return the map with landmarks at new places, fixed to the vertices that they had."""
    vertices = map_.landmarks.vertex[rows]
    p_base, covariance = map_.landmarks.p_base.copy(), map_.landmarks.covariance.copy()
    p_base[rows], covariance[rows] = _in_base(map_, vertices, located, chosen)
    return replace(map_, landmarks=replace(map_.landmarks, p_base=p_base, covariance=covariance))


def _left_over(map_: Map) -> tuple[IntArray, IntArray]:
    """Return observations (N,) of tracks none of which has a landmark, by track and time, and their groups."""
    seen = map_.observations
    has_track = np.flatnonzero(seen.track >= 0)
    kinds, _ = numbered(seen.kind[has_track])
    mission = map_.vertices.mission[seen.vertex[has_track]]
    keys = np.stack([mission, kinds, seen.track[has_track]])
    stamps_ns = map_.vertices.stamp_ns[seen.vertex[has_track]]
    order = np.lexsort((stamps_ns, *keys[::-1]))
    rows, keys = has_track[order], keys[:, order]
    is_new = np.append(True, (np.diff(keys, axis=1) != 0).any(axis=0))[: len(rows)]
    group = np.cumsum(is_new) - 1
    is_done = np.zeros(int(is_new.sum()), bool)
    is_done[group[seen.landmark[rows] >= 0]] = True
    left = ~is_done[group]
    return rows[left], np.unique(group[left], return_inverse=True)[1].astype(np.int64)


def _landmarks(map_: Map, first: IntArray, located: Located, chosen: BoolArray) -> Landmarks:
    """Return rows of landmarks, fixed to the vertices of their first observations."""
    seen = map_.observations
    vertices = seen.vertex[first]
    p_base, covariance = _in_base(map_, vertices, located, chosen)
    names = zip(
        map_.vertices.id[vertices], seen.kind[first], seen.track[first].tolist(), strict=True
    )
    return Landmarks(
        id=id_array(derived_id("track", vertex.tobytes(), kind, t) for vertex, kind, t in names),
        kind=seen.kind[first],
        vertex=vertices,
        p_base=p_base,
        covariance=covariance,
    )


def _labels(map_: Map, rows: IntArray, group: IntArray) -> TextArray:
    """Return the class (G,) that most observations of each group have; of several the first by name."""
    labels, number = np.unique(map_.observations.label[rows].astype(str), return_inverse=True)
    if not len(labels):
        return np.empty(0, object)
    votes = np.zeros((int(group[-1]) + 1, len(labels)), np.int64)
    np.add.at(votes, (group, number), 1)
    chosen: TextArray = labels.astype(object)[votes.argmax(axis=1)]
    return chosen


def _in_base(
    map_: Map, vertices: IntArray, located: Located, chosen: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return positions and covariances in the bases of these vertices."""
    T = invert(map_.T_map_base(vertices))
    R = T[:, :3, :3]
    p_base = np.einsum("nij,nj->ni", R, located.positions[chosen]) + T[:, :3, 3]
    covariance = R @ located.covariance[chosen] @ np.swapaxes(R, 1, 2)
    return p_base, (covariance + np.swapaxes(covariance, 1, 2)) / 2


def _report(located: Located) -> LocateReport:
    reasons, counts = np.unique(located.outcome.astype(str), return_counts=True)
    by_reason = dict(zip(reasons.tolist(), counts.tolist(), strict=True))
    num_found = by_reason.pop(FOUND, 0)
    return LocateReport(num_found=num_found, not_found=by_reason)
