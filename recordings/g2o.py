"""Pose graphs in g2o's format, as maps.

g2o knows numbers, not times: reading makes a vertex's number its stamp, and writing numbers vertices anew, from
0, in the order of missions and stamps. `g2o_text.py` tells how the matrices are read.
"""

from __future__ import annotations

import heapq
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapstream.recordings.g2o_text import (
    LIFTED,
    PLANAR_VARIANCE,
    G2oGraph,
    format_g2o,
    parse_g2o,
)
from mapstream.recordings.maps.build import append_edges, new_mission
from mapstream.recordings.maps.folder import write_whole
from mapstream.recordings.maps.ids import mission_id
from mapstream.recordings.maps.model import Map, vertex_ids
from mapstream.recordings.maps.tables import BoolArray, Edges, Vertices
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import invert
from mapstream.streams.messages.sensors import FloatArray, IntArray


def read_g2o(path: Path | str) -> Map:
    """Read a pose graph as a map of one mission; vertices without a line are placed along the edges.

    Edges between following numbers are odometry, all others are loops; `FIX` is an edge of kind `fixed`.

    Raises:
        RecordingError: If the file is not understood; the message has the file and the line.
    """
    path = Path(path)
    graph = parse_g2o(path)
    poses = _placed(graph, path)
    numbers = np.array(sorted(poses), dtype=np.int64)
    mission = mission_id(path.name)
    vertices = Vertices(
        id=vertex_ids(mission, numbers),
        mission=np.zeros(len(numbers), dtype=np.int64),
        stamp_ns=numbers,
        T_mission_base=np.array([poses[number] for number in numbers.tolist()]),
    )
    map_ = replace(new_mission(Map.empty(), mission, name=path.name), vertices=vertices)
    map_ = append_edges(map_, _relative_edges(graph, numbers, path))
    fixed = np.searchsorted(numbers, graph.fixed)
    return append_edges(map_, _fixed_edges(fixed, vertices.T_mission_base[fixed]))


def _placed(graph: G2oGraph, path: Path) -> dict[int, FloatArray]:
    """Return a pose for every vertex; those without one follow from edges between near numbers first."""
    ends: list[tuple[int, int]] = [(a, b) for a, b in graph.ends.tolist()]
    neighbours: dict[int, list[int]] = defaultdict(list)
    for index, (a, b) in enumerate(ends):
        neighbours[a].append(index)
        neighbours[b].append(index)
    given = zip(graph.numbers.tolist(), graph.poses, strict=True)
    poses: dict[int, FloatArray] = dict(given) or {min(neighbours): np.eye(4)}
    found = list(poses)
    leads: list[tuple[int, int]] = []  # edges from a known vertex, by the distance of their numbers
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
        raise RecordingError(f"{path}: no line places vertex {lost[0]}, and no edge leads there")
    return poses


def _relative_edges(graph: G2oGraph, numbers: IntArray, path: Path) -> Edges:
    a, b = graph.ends.T
    return Edges(
        kind=np.where(np.abs(b - a) == 1, "odometry", "loop").astype(object),
        vertex_a=np.searchsorted(numbers, a),
        vertex_b=np.searchsorted(numbers, b),
        T_a_b=graph.T_a_b,
        covariance=_covariances(graph, path),
        source=np.full(len(a), "g2o", dtype=object),
    )


def _fixed_edges(rows: IntArray, T_map_base: FloatArray) -> Edges:
    return Edges(
        kind=np.full(len(rows), "fixed", dtype=object),
        vertex_a=rows,
        vertex_b=np.full(len(rows), -1),
        T_a_b=T_map_base,
        covariance=np.zeros((len(rows), 6, 6)),
        source=np.full(len(rows), "g2o", dtype=object),
    )


def _covariances(graph: G2oGraph, path: Path) -> FloatArray:
    """Return the inverses of the information matrices; infinite where there is no information at all."""
    information = graph.information
    unmeasured = (information == 0).all(axis=2)[:, :, None] & np.eye(6, dtype=bool)
    filled = np.where(unmeasured, 1.0, information)
    refused = np.flatnonzero(np.linalg.eigvalsh(filled)[:, 0] <= 0)
    if len(refused):
        line = graph.edge_lines[refused[0]]
        raise RecordingError(
            f"{path}, line {line}: the information matrix is not positive definite"
        )
    covariance = np.linalg.inv(filled)
    covariance = (covariance + np.swapaxes(covariance, 1, 2)) / 2
    return np.where(unmeasured, np.inf, covariance)


def write_g2o(map_: Map, path: Path | str) -> Counter[str]:
    """Write the poses and relative transforms of a map, in the map frame.

    A map whose poses and measurements all lie in a plane is written as a planar graph.

    Returns:
        How many edges the format has no place for, by kind; loops that were switched off are among them.

    Raises:
        RecordingError: If the file cannot be written.
    """
    vertices, edges = map_.vertices, map_.edges
    rows = np.lexsort((vertices.stamp_ns, vertices.mission))
    number = np.empty(len(rows), dtype=np.int64)
    number[rows] = np.arange(len(rows))
    is_fixed, is_written = edges.kind == "fixed", _is_written(edges)
    chosen = np.flatnonzero(is_written)
    graph = G2oGraph(
        numbers=np.arange(len(rows)),
        poses=map_.T_map_base(rows),
        ends=number[np.column_stack([edges.vertex_a[chosen], edges.vertex_b[chosen]])],
        T_a_b=edges.T_a_b[chosen],
        information=_informations(edges.covariance[chosen]),
        fixed=number[edges.vertex_a[is_fixed]],
        edge_lines=chosen,
    )
    try:
        write_whole(Path(path), "".join(format_g2o(graph, is_planar=_is_planar(graph))).encode())
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error}") from error
    return Counter(edges.kind[~is_written & ~is_fixed].tolist())


def _is_written(edges: Edges) -> BoolArray:
    is_measured = np.isfinite(np.diagonal(edges.covariance, axis1=1, axis2=2)).any(axis=1)
    is_relative = (edges.vertex_b >= 0) & (edges.kind != "imu")
    written: BoolArray = is_relative & is_measured & (edges.switch >= 0.5)
    return written


def _informations(covariance: FloatArray) -> FloatArray:
    """Return the inverses; zero where the variance is infinite."""
    unmeasured = np.isinf(np.diagonal(covariance, axis1=1, axis2=2))
    cross = unmeasured[:, :, None] | unmeasured[:, None, :]
    information = np.linalg.inv(np.where(cross, np.eye(6), covariance))
    return np.where(cross, 0.0, (information + np.swapaxes(information, 1, 2)) / 2)


def _is_planar(graph: G2oGraph) -> bool:
    third_rows = np.concatenate([graph.poses, graph.T_a_b])[:, 2]
    lifted = graph.information[:, LIFTED] * PLANAR_VARIANCE
    is_flat = np.allclose(third_rows, [0, 0, 1, 0], rtol=0, atol=1e-12)
    return is_flat and np.allclose(lifted, np.eye(6)[LIFTED], rtol=0, atol=1e-9)
