"""How maps grow: missions, edges, poses, resources. Every function returns a new map."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.recordings.maps.ids import derived_id, id_array, id_bytes
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate, take
from mapstream.recordings.maps.tables import Edges, Missions, Resources
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import RelativePose
from mapstream.streams.messages.sensors import RecordRef


def new_mission(map_: Map, mission_id: str, *, name: str = "", sensors: str = "{}") -> Map:
    """Return the map with one more mission, which has no vertices yet.

    The first mission of a map defines the map frame; where later ones lie is not known.

    Raises:
        MapError: If the map has this mission.
    """
    if mission_id in [map_.mission_id(row) for row in range(len(map_.missions))]:
        raise MapError(f"mission {mission_id} is in the map already")
    mission = Missions(
        id=id_array([id_bytes(mission_id)]),
        name=np.array([name], dtype=object),
        T_map_mission=np.eye(4)[None],
        is_base_frame_known=np.array([len(map_.missions) == 0]),
        sensors=np.array([sensors], dtype=object),
    )
    return replace(map_, missions=concatenate([map_.missions, mission]))


def add_edges(map_: Map, edges: Sequence[RelativePose]) -> Map:
    """Return the map with measured transforms between its vertices.

    Raises:
        MapError: If there is no vertex where an edge begins or ends.
    """
    if not edges:
        return map_
    rows_a = _rows_at(map_, [e.mission_a for e in edges], [e.stamp_a_ns for e in edges])
    rows_b = _rows_at(map_, [e.mission_b for e in edges], [e.stamp_b_ns for e in edges])
    added = Edges(
        kind=np.array([e.kind for e in edges], dtype=object),
        vertex_a=rows_a,
        vertex_b=rows_b,
        T_a_b=np.array([e.T_a_b.matrix for e in edges]),
        covariance=np.array([e.covariance for e in edges]),
        is_switchable=np.array([e.is_switchable for e in edges]),
        source=np.array([e.source for e in edges], dtype=object),
    )
    return append_edges(map_, added)


def append_edges(map_: Map, added: Edges) -> Map:
    """Return the map with rows of edges, which get their ids here.

    The n-th edge of one kind and source between the same ends has the same id wherever it is added.
    """
    seen = Counter(_identities(take(map_.edges, np.isin(map_.edges.vertex_a, added.vertex_a))))
    vertices, landmarks = map_.vertices.id, map_.landmarks.id
    tables = (vertices, vertices, landmarks, landmarks)
    ids = []
    for identity in _identities(added):
        kind, source, *rows = identity
        ends = [t[row].tobytes() if row >= 0 else b"" for t, row in zip(tables, rows, strict=True)]
        ids.append(derived_id("edge", kind, source, *ends, seen[identity]))
        seen[identity] += 1
    return replace(map_, edges=concatenate([map_.edges, replace(added, id=id_array(ids))]))


def _identities(edges: Edges) -> Iterator[tuple[Any, ...]]:
    ends = (edges.vertex_a, edges.vertex_b, edges.landmark_a, edges.landmark_b)
    return zip(edges.kind, edges.source, *(rows.tolist() for rows in ends), strict=True)


def _rows_at(map_: Map, missions: Sequence[str], stamps_ns: Sequence[int]) -> IntArray:
    named, stamps = np.array(missions, dtype=object), np.array(stamps_ns, dtype=np.int64)
    rows = np.empty(len(stamps), dtype=np.int64)
    for mission in dict.fromkeys(missions):
        here = named == mission
        rows[here] = map_.vertex_rows(mission, stamps[here])
    return rows


def with_poses(map_: Map, vertex_rows: npt.NDArray[np.int64], T_mission_base: npt.ArrayLike) -> Map:
    """Return the map with other poses (N, 4, 4) in these rows (N,) of its vertices."""
    poses = map_.vertices.T_mission_base.copy()
    poses[vertex_rows] = T_mission_base
    return replace(map_, vertices=replace(map_.vertices, T_mission_base=poses))


def anchored(map_: Map, mission_row: int, T_map_mission: SE3) -> Map:
    """Return the map with a mission whose place in the map frame is now known."""
    frames = map_.missions.T_map_mission.copy()
    is_known = map_.missions.is_base_frame_known.copy()
    frames[mission_row], is_known[mission_row] = T_map_mission.matrix, True
    missions = replace(map_.missions, T_map_mission=frames, is_base_frame_known=is_known)
    return replace(map_, missions=missions)


def add_records(map_: Map, records: Sequence[tuple[int, RecordRef]]) -> Map:
    """Return the map with references into recordings, each with the row of its vertex."""
    return add_resources(
        map_,
        vertex_rows=np.array([row for row, _ in records], dtype=np.int64),
        kind="record",
        paths=[record.path for _, record in records],
        topics=[record.topic for _, record in records],
        log_ns=[record.log_ns for _, record in records],
    )


def add_resources(
    map_: Map,
    *,
    vertex_rows: npt.NDArray[np.int64],
    kind: str,
    paths: Sequence[str],
    topics: Sequence[str] | None = None,
    log_ns: Sequence[int] | None = None,
) -> Map:
    """Return the map with references of vertices (N,) to files of its folder, or into recordings."""
    if not paths:
        return map_
    topics = topics or [""] * len(paths)
    log_ns = log_ns or [0] * len(paths)
    owners = [row.tobytes() for row in map_.vertices.id[vertex_rows]]
    places = zip(owners, paths, topics, log_ns, strict=True)
    added = Resources(
        id=id_array(derived_id("resource", kind, *place) for place in places),
        vertex=vertex_rows,
        kind=np.array([kind] * len(paths), dtype=object),
        path=np.array(paths, dtype=object),
        topic=np.array(topics, dtype=object),
        log_ns=np.array(log_ns, dtype=np.int64),
    )
    return replace(map_, resources=concatenate([map_.resources, added]))
