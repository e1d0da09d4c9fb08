"""Rules on how rows belong together: ids, stamps, edges, missions.

Each gets a map whose references all lead somewhere.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mapstream.recordings.maps.columns import IdArray, columns_of, references_of
from mapstream.recordings.maps.findings import Finding, Rule, where
from mapstream.recordings.maps.ids import as_keys, id_array, vertex_id
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, IntArray

_OF_ONE_MISSION = ["imu", "odometry", "wheel", "motion_model"]


def references_lead_somewhere(map_: Map) -> Iterable[Finding]:
    """A reference is a row of its table, or -1 where that is allowed."""
    tables = map_.tables()
    for name, table in tables.items():
        for column in references_of(type(table)):
            rows, target = getattr(table, column.name), str(column.refers_to)
            least = -1 if column.is_optional else 0
            broken = (rows < least) | (rows >= len(tables[target]))
            yield from where(broken, name, f"{column.name} leads to no row of {target}")


def ids_are_unique(map_: Map) -> Iterable[Finding]:
    """No two rows of a table have one id."""
    for name, table in map_.tables().items():
        if columns_of(type(table))[0].name == "id":
            ids: IdArray = table.id  # type: ignore[attr-defined]  # just asked
            yield from where(_is_repeated(ids), name, "the id is that of an earlier row")


def _is_repeated(ids: IdArray) -> BoolArray:
    repeated = np.ones(len(ids), dtype=bool)
    repeated[np.unique(as_keys(ids), return_index=True)[1]] = False
    return repeated


def vertex_ids_are_derived(map_: Map) -> Iterable[Finding]:
    """The id of a vertex is that of its mission and stamp, so that maps made apart agree."""
    vertices = map_.vertices
    missions = [row.tobytes() for row in map_.missions.id]
    pairs = zip(vertices.mission.tolist(), vertices.stamp_ns.tolist(), strict=True)
    expected = id_array(vertex_id(missions[mission], stamp_ns) for mission, stamp_ns in pairs)
    broken = (expected != vertices.id).any(axis=1)
    yield from where(broken, "vertices", "the id is not that of the mission and the stamp")


def stamps_increase(map_: Map) -> Iterable[Finding]:
    """The vertices of a mission come in the order of their stamps, and no two at one time."""
    vertices = map_.vertices
    order = np.argsort(vertices.mission, kind="stable")
    same = np.diff(vertices.mission[order]) == 0
    broken = np.zeros(len(vertices), dtype=bool)
    broken[order[1:]] = same & (np.diff(vertices.stamp_ns[order]) <= 0)
    yield from where(broken, "vertices", "not later than the vertex before it in its mission")


def edges_lead_somewhere_else(map_: Map) -> Iterable[Finding]:
    """An edge has an end, its second end only beside a first one, and does not lead back to it."""
    edges = map_.edges
    loose = (edges.vertex_a < 0) & (edges.landmark_a < 0)
    yield from where(loose, "edges", "has neither a vertex nor a landmark")
    for what, a, b in (
        ("vertex", edges.vertex_a, edges.vertex_b),
        ("landmark", edges.landmark_a, edges.landmark_b),
    ):
        yield from where((a < 0) & (b >= 0), "edges", f"has a second {what} and no first one")
        yield from where((a >= 0) & (a == b), "edges", f"joins a {what} to itself")


def frames_have_names_of_their_own(map_: Map) -> Iterable[Finding]:
    """Measurements name outer frames, so no two have one name."""
    names = map_.frames.name.astype(str)
    repeated = np.ones(len(names), dtype=bool)
    repeated[np.unique(names, return_index=True)[1]] = False
    yield from where(repeated | (names == ""), "frames", "the name is empty or that of another one")


def motion_stays_in_its_mission(map_: Map) -> Iterable[Finding]:
    """What a robot measured of its own motion joins vertices of one mission."""
    edges, mission = map_.edges, map_.vertices.mission
    binary = (edges.vertex_a >= 0) & (edges.vertex_b >= 0)
    broken = np.isin(edges.kind, _OF_ONE_MISSION) & ~binary
    broken[binary] = np.isin(edges.kind[binary], _OF_ONE_MISSION) & (
        mission[edges.vertex_a[binary]] != mission[edges.vertex_b[binary]]
    )
    yield from where(
        broken, "edges", lambda row: f"an edge of kind {edges.kind[row]} leaves its mission"
    )


def imu_edges_join_neighbours(map_: Map) -> Iterable[Finding]:
    """IMU edges join consecutive vertices only (maplab 2.0, section III-A1)."""
    following = np.full(len(map_.vertices), -1)
    for mission in range(len(map_.missions)):
        rows = map_.vertices_of(mission)
        following[rows[:-1]] = rows[1:]
    edges = map_.edges
    is_imu = edges.kind == "imu"
    broken = np.zeros(len(edges), dtype=bool)
    broken[is_imu] = following[edges.vertex_a[is_imu]] != edges.vertex_b[is_imu]
    yield from where(broken, "edges", "an IMU edge must lead to the next vertex of its mission")


def imu_samples_belong_to_imu_edges(map_: Map) -> Iterable[Finding]:
    """Raw samples hang on edges of kind imu."""
    broken = map_.edges.kind[map_.imu.edge] != "imu"
    yield from where(broken, "imu", "a sample of an edge that is not of kind imu")


def imu_samples_are_in_order(map_: Map) -> Iterable[Finding]:
    """The samples of an edge lie together and do not run backwards."""
    imu = map_.imu
    same = np.diff(imu.edge) == 0
    broken = np.zeros(len(imu), dtype=bool)
    broken[1:] = same & (np.diff(imu.stamp_ns) < 0)
    starts = np.flatnonzero(np.append(True, ~same)) if len(imu) else np.empty(0, dtype=np.int64)
    first = np.unique(imu.edge[starts], return_index=True)[1]
    broken[np.delete(starts, first)] = True
    yield from where(broken, "imu", "not after the sample before it of the same edge")


def detections_are_of_objects(map_: Map) -> Iterable[Finding]:
    """What a detection tells more of is an observation of kind object."""
    other = map_.observations.kind[map_.detections.observation] != "object"
    yield from where(other, "detections", "its observation is not of kind object")


def missions_are_connected(map_: Map) -> Iterable[Finding]:
    """Edges within a mission join all of its vertices."""
    component = components(map_)
    for mission in range(len(map_.missions)):
        rows = map_.vertices_of(mission)
        parts = np.unique(component[rows])
        if len(parts) > 1:
            loose = rows[component[rows] != component[rows[0]]][0]
            sentence = f"falls apart into {len(parts)} pieces; vertex {loose} begins another one"
            yield Finding("missions", np.array([mission]), sentence)


def components(map_: Map) -> IntArray:
    """Return the number of the connected part of its mission for each vertex (V,)."""
    from scipy.sparse import coo_array  # noqa: PLC0415  # slow to import
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    edges, mission = map_.edges, map_.vertices.mission
    rows = np.flatnonzero((edges.vertex_a >= 0) & (edges.vertex_b >= 0))
    rows = rows[mission[edges.vertex_a[rows]] == mission[edges.vertex_b[rows]]]
    ends = (edges.vertex_a[rows], edges.vertex_b[rows])
    size = (len(map_.vertices), len(map_.vertices))
    joined = coo_array((np.ones(len(rows)), ends), shape=size)
    component: IntArray = connected_components(joined, directed=False)[1]
    return component


STRUCTURE_RULES: tuple[Rule, ...] = (
    ids_are_unique,
    vertex_ids_are_derived,
    stamps_increase,
    edges_lead_somewhere_else,
    frames_have_names_of_their_own,
    motion_stays_in_its_mission,
    imu_edges_join_neighbours,
    imu_samples_belong_to_imu_edges,
    imu_samples_are_in_order,
    detections_are_of_objects,
    missions_are_connected,
)
