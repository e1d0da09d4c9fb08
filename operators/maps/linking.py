"""Edges over stretches of vertices: what leads through a stretch step by step becomes one edge over it.

Motions are composed with their covariances, IMU samples are joined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapstream.operators.maps.composing import Motion, composed
from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.edge_kinds import MOTION_KINDS
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate, take
from mapstream.recordings.maps.tables import Edges, ImuSamples
from mapstream.streams.arrays import IntArray


def linked(map_: Map, stretches: Sequence[IntArray]) -> tuple[Map, int]:
    """Return the map with edges from the first to the last vertex of stretches, and how many there are.

    One edge comes for each kind and source that leads all the way; the edges inside stay.

    Args:
        map_: The map.
        stretches: Rows of vertices, in order; one may begin where another ends.
    """
    paths = [path for path in _paths(map_, stretches) if len(path) > 1]
    kinds = map_.edges.kind
    moving = [path for path in paths if kinds[path[0]] in MOTION_KINDS]
    inertial = [path for path in paths if kinds[path[0]] == "imu"]
    first_imu = len(map_.edges) + len(moving)
    added = [*(_motion(map_, path) for path in moving), *(_over(map_, path) for path in inertial)]
    if not added:
        return map_, 0
    samples = _joined_samples(map_, inertial, first_imu)
    map_ = append_edges(map_, concatenate(added))
    return replace(map_, imu=concatenate([map_.imu, *samples])), len(added)


def _paths(map_: Map, stretches: Sequence[IntArray]) -> list[list[int]]:
    """Return rows of edges that lead through each stretch, by kind and source; empty where none do."""
    edges, num = map_.edges, len(map_.vertices) + 1  # the last stands for no vertex
    leaves, enters = np.full(num, -1), np.full(num, -1)
    position_out, position_in = np.zeros(num, np.int64), np.zeros(num, np.int64)
    for number, stretch in enumerate(stretches):
        leaves[stretch[:-1]], position_out[stretch[:-1]] = number, np.arange(len(stretch) - 1)
        enters[stretch[1:]], position_in[stretch[1:]] = number, np.arange(1, len(stretch))
    stretch_of, start = leaves[edges.vertex_a], position_out[edges.vertex_a]
    end = position_in[edges.vertex_b]
    is_inside = (stretch_of >= 0) & (stretch_of == enters[edges.vertex_b]) & (end > start)
    groups: dict[tuple[int, str, str], dict[int, int]] = {}
    for row in np.flatnonzero(is_inside).tolist():
        name = (int(stretch_of[row]), edges.kind[row], edges.source[row])
        groups.setdefault(name, {})[int(start[row])] = row
    return [_path(groups[name], end, len(stretches[name[0]])) for name in sorted(groups)]


def _path(leaving: dict[int, int], end: IntArray, length: int) -> list[int]:
    """Return the rows of edges that lead from position 0 to the last one; empty where none do."""
    path, at = list[int](), 0
    while at < length - 1:
        row = leaving.get(at)
        if row is None:
            return []
        path.append(row)
        at = int(end[row])
    return path


def _over(map_: Map, path: list[int]) -> Edges:
    """Return the edge from the first end of a path to its last, with all else from its first edge."""
    first = take(map_.edges, np.array(path[:1]))
    return replace(first, vertex_b=map_.edges.vertex_b[path[-1:]])


def _motion(map_: Map, path: list[int]) -> Edges:
    edges = map_.edges
    motion = composed(Motion(edges.T_a_b_of(row), edges.covariance[row]) for row in path)
    return replace(
        _over(map_, path),
        T_a_b=motion.T.matrix[None],
        covariance=motion.covariance[None],
        switch=edges.switch[path].min(keepdims=True),
    )


def _joined_samples(map_: Map, paths: list[list[int]], first_edge: int) -> list[ImuSamples]:
    """Return the samples of IMU edges one after another; the one at a vertex ends one and begins the next."""
    edges, starts = np.unique(map_.imu.edge, return_index=True)
    ends = np.append(starts[1:], len(map_.imu))[: len(starts)]
    span = {row: np.arange(a, b) for row, a, b in zip(edges.tolist(), starts, ends, strict=True)}
    nothing = np.zeros(0, np.int64)
    joined = []
    for number, path in enumerate(paths):
        rows = np.concatenate([span.get(row, nothing) for row in path])
        stamps_ns = map_.imu.stamp_ns[rows]
        newest_ns = np.maximum.accumulate(np.append(-1, stamps_ns))[:-1]
        samples = take(map_.imu, rows[stamps_ns > newest_ns])
        joined.append(replace(samples, edge=np.full(len(samples), first_edge + number)))
    return joined
