"""Pose graphs in g2o's format, as maps.

g2o knows numbers, not times: reading makes a vertex's number its stamp, and writing numbers vertices anew, from
0, in the order of missions and stamps. `g2o_text.py` tells how the matrices are read.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from mapstream.recordings.g2o_text import (
    LIFTED,
    PLANAR_VARIANCE,
    G2oGraph,
    format_g2o,
    parse_g2o,
)
from mapstream.recordings.maps.edge_kinds import RELATIVE_KINDS
from mapstream.recordings.maps.folder import write_whole
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Edges
from mapstream.recordings.pose_graph import ROBOT_SHIFT, PoseGraph, map_of, robots_of
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.errors import RecordingError


def read_g2o(*paths: Path | str, are_loops_switchable: bool = False) -> Map:
    """Read the pose graph of these files; vertices without a line are placed along the edges.

    Vertices with letters, as gtsam's symbols have, are of several robots: each becomes a mission, and the same
    edge between two robots in the files of both counts once. Without letters, each file is a mission.
    Edges between following numbers are odometry, all others are loops; `FIX` is an edge of kind `fixed`.

    Args:
        paths: The files.
        are_loops_switchable: Whether an optimizer may find loops within a mission false; those between
            missions it may in any case.

    Raises:
        RecordingError: If a file is not understood; the message has the file and the line.
    """
    files = [Path(path) for path in paths]
    texts = [parse_g2o(path) for path in files]
    has_letters = any(robots_of(_keys(text)).any() for text in texts)
    if not has_letters:
        texts = [_of_robot(text, robot) for robot, text in enumerate(texts)]
    graphs = [_pose_graph(*each) for each in zip(texts, files, strict=True)]
    graph = _joined(graphs)
    is_loop = np.abs(graph.ends[:, 1] - graph.ends[:, 0]) != 1
    if are_loops_switchable:
        graph = replace(graph, is_switchable=is_loop)
    try:
        return map_of(graph, _names(texts, files, has_letters=has_letters), "g2o")
    except RecordingError as error:
        raise RecordingError(f"{', '.join(map(str, files))}: {error}") from error


def _keys(text: G2oGraph) -> IntArray:
    """Return the keys of all vertices of a file."""
    return np.unique(np.concatenate([text.numbers, text.ends.ravel(), text.fixed]))


def _of_robot(text: G2oGraph, robot: int) -> G2oGraph:
    """Return the file's graph with keys of this robot."""
    first = robot << ROBOT_SHIFT
    return replace(
        text, numbers=text.numbers + first, ends=text.ends + first, fixed=text.fixed + first
    )


def _names(texts: list[G2oGraph], files: list[Path], *, has_letters: bool) -> dict[int, str]:
    """Return a name for each robot: of the file where its vertices are, and its letter."""
    are_unique = len({path.name for path in files}) == len(files)
    names: dict[int, str] = {}
    for keys_of in (lambda text: text.numbers, _keys):
        for text, path in zip(texts, files, strict=True):
            name = path.name if are_unique else f"{path.parent.name}/{path.name}"
            for robot in np.unique(robots_of(keys_of(text))).tolist():
                names.setdefault(robot, f"{name} {_letter(robot)}" if has_letters else name)
    return names


def _letter(robot: int) -> str:
    return chr(robot) if chr(robot).isprintable() else str(robot)


def _pose_graph(text: G2oGraph, path: Path) -> PoseGraph:
    robots = robots_of(text.ends)
    return PoseGraph(
        keys=text.numbers,
        poses=text.poses,
        ends=text.ends,
        T_a_b=text.T_a_b,
        covariance=_covariances(text, path),
        is_switchable=robots[:, 0] != robots[:, 1],
        fixed=text.fixed,
    )


def _joined(graphs: list[PoseGraph]) -> PoseGraph:
    """Return one graph; a vertex has its first pose, and edges in several files count once."""
    if len(graphs) == 1:
        return graphs[0]
    columns = {
        each.name: np.concatenate([getattr(graph, each.name) for graph in graphs])
        for each in fields(PoseGraph)
    }
    _, first = np.unique(columns["keys"], return_index=True)
    columns["keys"], columns["poses"] = columns["keys"][first], columns["poses"][first]
    of_file = np.repeat(np.arange(len(graphs)), [len(graph.ends) for graph in graphs])
    once = _first_files(columns["ends"], columns["T_a_b"], of_file)
    for name in ("ends", "T_a_b", "covariance", "is_switchable"):
        columns[name] = columns[name][once]
    columns["fixed"] = np.unique(columns["fixed"])
    return PoseGraph(**columns)


def _first_files(ends: IntArray, T_a_b: FloatArray, of_file: IntArray) -> BoolArray:
    """Return where an edge is in the first file that has it."""
    identity = [row.tobytes() + T.tobytes() for row, T in zip(ends, T_a_b, strict=True)]
    first: dict[bytes, int] = {}
    for each, file in zip(identity, of_file.tolist(), strict=True):
        first.setdefault(each, file)
    is_first: BoolArray = np.array([first[each] for each in identity], dtype=np.int64) == of_file
    return is_first


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
    is_fixed = (edges.kind == "fixed") & (edges.vertex_a >= 0)
    is_written = _is_written(edges)
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
    is_relative = (edges.vertex_a >= 0) & (edges.vertex_b >= 0)
    is_relative &= np.isin(edges.kind, RELATIVE_KINDS)
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
