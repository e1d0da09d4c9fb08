"""Parts of one mission that were mapped apart, such as submaps: how one follows on another.

Two parts share at least one vertex, and between their vertices they measured the same.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapstream.recordings.maps.ids import as_keys
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import invert

_MEASURED = (
    "kind",
    "T_a_b",
    "covariance",
    "payload",
)  # what an edge says; its switch is an estimate


class NoCommonVertexError(MapError):
    """Two parts of a mission do not touch; a third one may lie between them."""


def following(added: Map, there: Map, mission_id: str) -> Map:
    """Return a map whose part of a mission lies where another map's part puts it.

    Where both have a vertex, the other's state counts; the vertices of this part keep to the nearest such one. The
    mission's frame becomes the other's, and what is in it stays where it was in the map at the last common vertex.

    Raises:
        NoCommonVertexError: If the parts share no vertex.
        MapError: If they differ where both are.
    """
    mission = added.mission_row(mission_id)
    mine, common_mine, common_there = _common(added, there, mission_id)
    _require_same_measurements(added, there, mission_id, common_mine)
    T_mission_base, vertices = there.vertices.T_mission_base, added.vertices
    T_there_mine = T_mission_base[common_there] @ invert(vertices.T_mission_base[common_mine])
    stamps_ns = vertices.stamp_ns[common_mine]
    nearest = np.abs(vertices.stamp_ns[mine][:, None] - stamps_ns).argmin(axis=1)
    poses, velocities = vertices.T_mission_base.copy(), vertices.velocity_mps.copy()
    poses[mine] = T_there_mine[nearest] @ poses[mine]
    poses[common_mine] = T_mission_base[common_there]
    R = T_there_mine[nearest, :3, :3]
    velocities[mine] = (R @ velocities[mine][:, :, None])[:, :, 0]
    T_map_mission = added.missions.T_map_mission.copy()
    T_map_mission[mission] = T_map_mission[mission] @ invert(T_there_mine[-1])
    return replace(
        added,
        vertices=replace(vertices, T_mission_base=poses, velocity_mps=velocities),
        missions=replace(added.missions, T_map_mission=T_map_mission),
    )


def _common(a: Map, b: Map, mission_id: str) -> tuple[IntArray, IntArray, IntArray]:
    """Return the rows of a mission's vertices in a, and those of the ones that b has, too, in both.

    Raises:
        NoCommonVertexError: If there are none.
        MapError: If one part has a vertex between two of the other that the other does not have.
    """
    rows_a, rows_b = (map_.vertices_of(map_.mission_row(mission_id)) for map_ in (a, b))
    stamps_a, stamps_b = a.vertices.stamp_ns[rows_a], b.vertices.stamp_ns[rows_b]
    common_ns, at_a, at_b = np.intersect1d(stamps_a, stamps_b, return_indices=True)
    if not len(common_ns):
        raise NoCommonVertexError(
            f"mission {mission_id} is in two maps that share no vertex: one is from {stamps_a[0]} to"
            f" {stamps_a[-1]} ns, one from {stamps_b[0]} to {stamps_b[-1]} ns; parts join where one ends and"
            " the next begins at the same vertex"
        )
    for at in (at_a, at_b):
        if at[-1] - at[0] + 1 != len(at):
            raise MapError(
                f"mission {mission_id} is in two maps, and between {common_ns[0]} and {common_ns[-1]} ns their"
                " vertices differ; remove it from one of them before merging"
            )
    return rows_a, rows_a[at_a], rows_b[at_b]


def _require_same_measurements(a: Map, b: Map, mission_id: str, common_a: IntArray) -> None:
    """Refuse parts of which one has an edge, or another measurement, between their common vertices.

    Raises:
        MapError: If there is one.
    """
    keys = as_keys(a.vertices.id[common_a])
    rows_a, rows_b = (_edges_inside(map_, keys) for map_ in (a, b))
    is_same = np.array_equal(as_keys(a.edges.id[rows_a]), as_keys(b.edges.id[rows_b])) and all(
        np.array_equal(getattr(a.edges, name)[rows_a], getattr(b.edges, name)[rows_b])
        for name in _MEASURED
    )
    if not is_same:
        raise MapError(
            f"mission {mission_id} is in two maps, and its edges differ where both are; remove it from one of"
            " them before merging"
        )


def _edges_inside(map_: Map, keys: np.ndarray[tuple[int], np.dtype[np.void]]) -> IntArray:
    """Return the rows of edges between two vertices of these ids, in the order of the edges' ids."""
    edges = map_.edges
    is_inside = np.append(np.isin(as_keys(map_.vertices.id), keys), False)  # the last: no vertex
    rows = np.flatnonzero(is_inside[edges.vertex_a] & is_inside[edges.vertex_b])
    ordered: IntArray = rows[np.argsort(as_keys(edges.id[rows]), kind="stable")]
    return ordered
