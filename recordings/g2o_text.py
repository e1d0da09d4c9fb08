"""g2o's text format: lines to arrays and back.

Information matrices there have translation first, ours rotation first. Their rotation part is taken for that of
the rotation vector, as gtsam and the published optima do, not of the quaternion's vector.
A planar graph is lifted to space with a fixed variance in z, roll and pitch: nothing moves there, so the
optimum is that of the plane, whatever the variance.
Source: Kuemmerle et al., g2o: a general framework for graph optimization, ICRA 2011.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import quat_xyzw_from_rotation, rotation_from_quat_xyzw

PLANAR_VARIANCE = 1e-4  # of z [m^2], roll and pitch [rad^2] in edges of planar graphs
LIFTED = [0, 1, 5]  # roll, pitch, z in our order
PLANAR = [3, 4, 2]  # x, y, yaw in our order
_SWAP = [3, 4, 5, 0, 1, 2]  # translation first <-> rotation first
_NUM_VALUES = {"VERTEX_SE2": 4, "VERTEX_SE3:QUAT": 8, "EDGE_SE2": 11, "EDGE_SE3:QUAT": 30}


@dataclass(frozen=True, slots=True, kw_only=True)
class G2oGraph:
    """What a file says, in its order."""

    numbers: IntArray  # (N,) of the vertices that have a pose
    poses: FloatArray  # (N, 4, 4)
    ends: IntArray  # (M, 2) numbers of the vertices a and b of an edge
    T_a_b: FloatArray  # (M, 4, 4)
    information: FloatArray  # (M, 6, 6) rotation first
    fixed: IntArray  # (F,) numbers of vertices that do not move
    edge_lines: IntArray  # (M,) for messages


@dataclass(frozen=True, slots=True)
class _Line:
    number: int
    tag: str
    ids: list[int]
    values: list[float]


def parse_g2o(path: Path) -> G2oGraph:
    """Read a file.

    Raises:
        RecordingError: If a line is not understood; the message has the file and the line.
    """
    try:
        text = path.read_text(encoding="ascii", errors="replace")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    lines = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#")[0].split()
        if words:
            lines.append(_parsed(words[0], words[1:], number, path))
    vertices = [line for line in lines if line.tag.startswith("VERTEX")]
    edges = [line for line in lines if line.tag.startswith("EDGE")]
    if not vertices and not edges:
        raise RecordingError(f"{path}: no vertices and no edges; is it a g2o file?")
    return G2oGraph(
        numbers=np.array([line.ids[0] for line in vertices], dtype=np.int64),
        poses=_poses(vertices),
        ends=np.array([line.ids for line in edges], dtype=np.int64).reshape(-1, 2),
        T_a_b=_poses(edges),
        information=_informations(edges),
        fixed=np.array(
            [i for line in lines if line.tag == "FIX" for i in line.ids], dtype=np.int64
        ),
        edge_lines=np.array([line.number for line in edges], dtype=np.int64),
    )


def _parsed(tag: str, words: list[str], number: int, path: Path) -> _Line:
    where = f"{path}, line {number}"
    num_words = _NUM_VALUES.get(tag, len(words))
    if tag not in _NUM_VALUES and tag != "FIX":
        known = ", ".join([*_NUM_VALUES, "FIX"])
        raise RecordingError(f"{where}: {tag!r} is not known here; known are {known}")
    if len(words) != num_words:
        raise RecordingError(f"{where}: expected {num_words} values after {tag}, got {len(words)}")
    num_ids = {"F": len(words), "V": 1, "E": 2}[tag[0]]
    try:
        line = _Line(
            number, tag, list(map(int, words[:num_ids])), list(map(float, words[num_ids:]))
        )
    except ValueError as error:
        raise RecordingError(f"{where}: {error}") from error
    if not all(0 <= i < 1 << 63 for i in line.ids):
        raise RecordingError(
            f"{where}: expected numbers of vertices from 0 to 2^63, got {line.ids}"
        )
    if not all(map(math.isfinite, line.values)):
        raise RecordingError(f"{where}: a value is not finite")
    is_rotation = tag.endswith("QUAT")
    if is_rotation and not any(line.values[3:7]):
        raise RecordingError(f"{where}: quaternion without a direction")
    return line


def _is_planar_line(lines: list[_Line]) -> BoolArray:
    return np.array([line.tag.endswith("SE2") for line in lines], dtype=bool)


def _poses(lines: list[_Line]) -> FloatArray:
    """Return the transforms (N, 4, 4) at the beginning of the values."""
    is_planar = _is_planar_line(lines)
    T = np.tile(np.eye(4), (len(lines), 1, 1))
    flat = np.array([line.values[:3] for line in lines if line.tag.endswith("SE2")]).reshape(-1, 3)
    full = np.array([line.values[:7] for line in lines if line.tag.endswith("QUAT")]).reshape(-1, 7)
    cos, sin = np.cos(flat[:, 2]), np.sin(flat[:, 2])
    T[is_planar, :2, 0] = np.column_stack([cos, sin])
    T[is_planar, :2, 1] = np.column_stack([-sin, cos])
    T[is_planar, :2, 3] = flat[:, :2]
    T[~is_planar, :3, :3] = rotation_from_quat_xyzw(full[:, 3:])
    T[~is_planar, :3, 3] = full[:, :3]
    return T


def _informations(lines: list[_Line]) -> FloatArray:
    """Return the matrices (N, 6, 6) in our order of the upper triangles at the end of the values."""
    information = np.zeros((len(lines), 6, 6))
    for row, line in enumerate(lines):
        is_planar = line.tag.endswith("SE2")
        order = PLANAR if is_planar else _SWAP
        i, j = np.triu_indices(len(order))
        at = np.array(order)
        information[row, at[i], at[j]] = information[row, at[j], at[i]] = line.values[-len(i) :]
        if is_planar:
            information[row, LIFTED, LIFTED] = 1 / PLANAR_VARIANCE
    return information


def format_g2o(graph: G2oGraph, *, is_planar: bool) -> Iterator[str]:
    """Yield the lines of a file; numbers are written so that they read back exactly."""
    kind = "SE2" if is_planar else "SE3:QUAT"
    order = np.array(PLANAR if is_planar else _SWAP)
    i, j = order[np.array(np.triu_indices(len(order)))]
    poses, measured = (_numbers(T, is_planar=is_planar) for T in (graph.poses, graph.T_a_b))
    for number, pose in zip(graph.numbers.tolist(), poses.tolist(), strict=True):
        yield f"VERTEX_{kind} {number} {_words(pose)}\n"
    for number in graph.fixed.tolist():
        yield f"FIX {number}\n"
    values = np.hstack([measured, graph.information[:, i, j]])
    for (a, b), row in zip(graph.ends.tolist(), values.tolist(), strict=True):
        yield f"EDGE_{kind} {a} {b} {_words(row)}\n"


def _numbers(T: FloatArray, *, is_planar: bool) -> FloatArray:
    if is_planar:
        return np.column_stack([T[:, 0, 3], T[:, 1, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0])])
    return np.hstack([T[:, :3, 3], quat_xyzw_from_rotation(T[:, :3, :3])])


def _words(numbers: list[float]) -> str:
    return " ".join(map(repr, numbers))
