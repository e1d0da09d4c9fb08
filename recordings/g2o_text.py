"""g2o's text format: lines to arrays and back.

Information matrices there have translation first, ours rotation first. Their rotation part is taken for that of
the rotation vector, as gtsam and the published optima do, not of the quaternion's vector.
A planar graph is lifted to space with a fixed variance in z, roll and pitch: nothing moves there, so the
optimum is that of the plane, whatever the variance.
Source: Kuemmerle et al., g2o: a general framework for graph optimization, ICRA 2011.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import quat_xyzw_from_rotation, rotation_from_quat_xyzw
from mapstream.streams.messages.sensors import FloatArray

PLANAR_VARIANCE = 1e-4  # of z [m^2], roll and pitch [rad^2] in edges of planar graphs
LIFTED = [0, 1, 5]  # roll, pitch, z in our order
_PLANAR = [3, 4, 2]  # x, y, yaw in our order
_SWAP = [3, 4, 5, 0, 1, 2]  # translation first <-> rotation first
_NUM_VALUES = {"VERTEX_SE2": 4, "VERTEX_SE3:QUAT": 8, "EDGE_SE2": 11, "EDGE_SE3:QUAT": 30}


@dataclass(frozen=True, slots=True)
class G2oEdge:
    """A measured transform between two numbered vertices."""

    a: int
    b: int
    T_a_b: FloatArray  # (4, 4)
    information: FloatArray  # (6, 6) rotation first
    where: str = ""  # file and line, for messages


@dataclass(slots=True)
class G2oGraph:
    """What a file says."""

    poses: dict[int, FloatArray] = field(default_factory=dict)  # number -> (4, 4)
    edges: list[G2oEdge] = field(default_factory=list)
    fixed: list[int] = field(default_factory=list)  # numbers of vertices that do not move


def parse_g2o(path: Path) -> G2oGraph:
    """Read a file.

    Raises:
        RecordingError: If a line is not understood; the message has the file and the line.
    """
    graph = G2oGraph()
    try:
        with path.open(encoding="ascii", errors="replace") as lines:
            for number, line in enumerate(lines, start=1):
                words = line.split("#")[0].split()
                if words:
                    _parse_line(graph, words[0], words[1:], f"{path}, line {number}")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    if not graph.poses and not graph.edges:
        raise RecordingError(f"{path}: no vertices and no edges; is it a g2o file?")
    return graph


def _parse_line(graph: G2oGraph, tag: str, values: list[str], where: str) -> None:
    num_values = _NUM_VALUES.get(tag, len(values))
    if tag not in _NUM_VALUES and tag != "FIX":
        known = ", ".join([*_NUM_VALUES, "FIX"])
        raise RecordingError(f"{where}: {tag!r} is not known here; known are {known}")
    if len(values) != num_values:
        raise RecordingError(
            f"{where}: expected {num_values} values after {tag}, got {len(values)}"
        )
    num_ids = {"F": len(values), "V": 1, "E": 2}[tag[0]]
    try:
        ids = [int(value) for value in values[:num_ids]]
        numbers = _finite(values[num_ids:])
        if tag == "FIX":
            graph.fixed += ids
        elif tag.startswith("VERTEX"):
            graph.poses[ids[0]] = _pose(numbers)
        else:
            size = 3 if tag == "EDGE_SE2" else 7
            T, information = _pose(numbers[:size]), _information(numbers[size:])
            graph.edges.append(G2oEdge(ids[0], ids[1], T, information, where))
    except ValueError as error:
        raise RecordingError(f"{where}: {error}") from error


def _finite(values: list[str]) -> FloatArray:
    numbers = np.array(values, dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise ValueError("a value is not finite")
    return numbers


def _pose(numbers: FloatArray) -> FloatArray:
    T = np.eye(4)
    if len(numbers) == 3:
        x, y, yaw = numbers
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T[:2, 3] = x, y
    else:
        T[:3, :3] = rotation_from_quat_xyzw(numbers[3:])
        T[:3, 3] = numbers[:3]
    return T


def _information(upper: FloatArray) -> FloatArray:
    """Return the matrix (6, 6) in our order of an upper triangle of 3 or 6 rows."""
    size = 3 if len(upper) == 6 else 6
    given = np.zeros((size, size))
    given[np.triu_indices(size)] = upper
    given += np.triu(given, 1).T
    if size == 6:
        return given[np.ix_(_SWAP, _SWAP)]
    information = np.zeros((6, 6))
    information[LIFTED, LIFTED] = 1 / PLANAR_VARIANCE
    information[np.ix_(_PLANAR, _PLANAR)] = given
    return information


def format_g2o(graph: G2oGraph, *, is_planar: bool) -> Iterator[str]:
    """Yield the lines of a file; numbers are written so that they read back exactly."""
    kind = "SE2" if is_planar else "SE3:QUAT"
    order = _PLANAR if is_planar else _SWAP
    upper = np.triu_indices(len(order))
    for number, T in graph.poses.items():
        yield f"VERTEX_{kind} {number} {_words(_pose_numbers(T, is_planar=is_planar))}\n"
    for number in graph.fixed:
        yield f"FIX {number}\n"
    for edge in graph.edges:
        pose = _words(_pose_numbers(edge.T_a_b, is_planar=is_planar))
        information = _words(edge.information[np.ix_(order, order)][upper])
        yield f"EDGE_{kind} {edge.a} {edge.b} {pose} {information}\n"


def _pose_numbers(T: FloatArray, *, is_planar: bool) -> FloatArray:
    if is_planar:
        return np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])
    return np.concatenate([T[:3, 3], quat_xyzw_from_rotation(T[:3, :3])])


def _words(numbers: FloatArray) -> str:
    return " ".join(repr(number) for number in numbers.tolist())
