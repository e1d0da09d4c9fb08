"""Pose graphs of one robot or several, as they come out of files, and the maps they are.

A vertex has a key: the robot's number in the highest byte, the vertex's own number below, as in gtsam's symbols
(`a7` is robot 97, vertex 7). Each robot becomes a mission, whose stamps are the numbers of its vertices.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mapstream.recordings.maps.build import append_edges, new_mission
from mapstream.recordings.maps.ids import mission_id
from mapstream.recordings.maps.model import Map, vertex_ids
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Edges, Vertices
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import invert

ROBOT_SHIFT = 56  # bits below the robot's number


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseGraph:
    """Poses and relative transforms; vertices may be named by edges alone."""

    keys: IntArray  # (N,) of the vertices that have a pose
    poses: FloatArray  # (N, 4, 4) T_mission_base
    ends: IntArray  # (M, 2) keys of the vertices a and b of an edge
    T_a_b: FloatArray  # (M, 4, 4)
    covariance: FloatArray  # (M, 6, 6) rotation first
    is_switchable: BoolArray  # (M,) whether the edge may be false
    fixed: IntArray  # (F,) keys of vertices that do not move


def robots_of(keys: IntArray) -> IntArray:
    """Return the number of each key's robot; 0 of keys without a letter."""
    return keys >> ROBOT_SHIFT


def numbers_of(keys: IntArray) -> IntArray:
    """Return the number of each vertex among those of its robot."""
    return keys & ((1 << ROBOT_SHIFT) - 1)


def map_of(graph: PoseGraph, names: Mapping[int, str], source: str) -> Map:
    """Return a map with a mission per robot; only the first one's base frame is known.

    Edges between following vertices of a robot are odometry, all others are loops.

    Args:
        graph: What the files say; vertices without a pose are placed along the edges.
        names: The name of each robot by its number, which its mission's id comes from.
        source: Where the edges are from.

    Raises:
        RecordingError: If no edge leads to a vertex without a pose.
    """
    keys, poses = placed(graph)
    map_ = Map.empty()
    tables = []
    for row, robot in enumerate(np.unique(robots_of(keys)).tolist()):
        here = robots_of(keys) == robot
        stamps_ns = numbers_of(keys[here])
        mission = mission_id(names[robot])
        map_ = new_mission(map_, mission, name=names[robot])
        tables.append(
            Vertices(
                id=vertex_ids(mission, stamps_ns),
                mission=np.full(len(stamps_ns), row),
                stamp_ns=stamps_ns,
                T_mission_base=poses[here],
            )
        )
    map_ = replace(map_, vertices=concatenate(tables))
    map_ = append_edges(map_, _relative_edges(graph, keys, source))
    return append_edges(map_, _fixed_edges(np.searchsorted(keys, graph.fixed), poses, source))


def placed(graph: PoseGraph) -> tuple[IntArray, FloatArray]:
    """Return all vertices, by increasing keys, and their poses (N, 4, 4).

    Those without a pose follow from edges between near keys first: along a robot's odometry before its loops,
    and along loops between robots last. Where no vertex has a pose, each robot begins at the origin.

    Raises:
        RecordingError: If no edge leads to a vertex.
    """
    ends: list[tuple[int, int]] = [(a, b) for a, b in graph.ends.tolist()]
    neighbours: dict[int, list[int]] = defaultdict(list)
    for index, (a, b) in enumerate(ends):
        neighbours[a].append(index)
        neighbours[b].append(index)
    given = zip(graph.keys.tolist(), graph.poses, strict=True)
    poses: dict[int, FloatArray] = dict(given) or _origins(graph)
    found = list(poses)
    leads: list[tuple[int, int]] = []  # edges from a known vertex, by the distance of their keys
    while found or leads:
        for vertex in found:
            for index in neighbours[vertex]:
                heapq.heappush(leads, (abs(ends[index][0] - ends[index][1]), index))
        found = []
        if leads:
            _, index = heapq.heappop(leads)
            a, b = ends[index]
            if b not in poses:
                poses[b] = poses[a] @ graph.T_a_b[index]
                found = [b]
            elif a not in poses:
                poses[a] = poses[b] @ invert(graph.T_a_b[index])
                found = [a]
    if lost := sorted((neighbours.keys() | set(graph.fixed.tolist())) - poses.keys()):
        raise RecordingError(f"no line places vertex {lost[0]}, and no edge leads there")
    keys = np.array(sorted(poses), dtype=np.int64)
    return keys, np.array([poses[key] for key in keys.tolist()]).reshape(-1, 4, 4)


def _origins(graph: PoseGraph) -> dict[int, FloatArray]:
    _, first = np.unique(robots_of(keys := np.unique(graph.ends)), return_index=True)
    return {key: np.eye(4) for key in keys[first].tolist()}


def _relative_edges(graph: PoseGraph, keys: IntArray, source: str) -> Edges:
    a, b = graph.ends.T
    rows = np.searchsorted(keys, graph.ends)
    return Edges(
        kind=np.where(np.abs(b - a) == 1, "odometry", "loop").astype(object),
        vertex_a=rows[:, 0],
        vertex_b=rows[:, 1],
        T_a_b=graph.T_a_b,
        covariance=graph.covariance,
        is_switchable=graph.is_switchable,
        source=np.full(len(a), source, dtype=object),
    )


def _fixed_edges(rows: IntArray, poses: FloatArray, source: str) -> Edges:
    return Edges(
        kind=np.full(len(rows), "fixed", dtype=object),
        vertex_a=rows,
        vertex_b=np.full(len(rows), -1),
        T_a_b=poses[rows],
        covariance=np.zeros((len(rows), 6, 6)),
        source=np.full(len(rows), source, dtype=object),
    )
