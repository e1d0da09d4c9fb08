"""Pose graphs of robot teams as Kimera-Multi writes them: `robot0/measurements.csv`, `robot1/measurements.csv` ...

A line is one relative transform: `robot_src,pose_src,robot_dst,pose_dst,qx,qy,qz,qw,tx,ty,tz,kappa,tau,is_known_inlier,weight`.
kappa and tau are the precisions of SE-Sync, 1 / (2 sigma^2) of the rotation and 1 / sigma^2 of the translation.
The weights are the result of another solver, and are not read.
Source: Tian et al., Resilient and Distributed Multi-Robot Visual SLAM, IROS 2023; Rosen et al., SE-Sync, IJRR 2019.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from mapstream.recordings.maps.model import Map
from mapstream.recordings.pose_graph import ROBOT_SHIFT, PoseGraph, map_of
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import rotation_from_quat_xyzw

HEADER = (
    "robot_src,pose_src,robot_dst,pose_dst,qx,qy,qz,qw,tx,ty,tz,kappa,tau,is_known_inlier,weight"
)
_FOLDER = re.compile(r"robot(\d+)$")


def read_kimera_multi(folder: Path | str) -> Map:
    """Read a team's measurements as a map with a mission per robot, each beginning at its own origin.

    What is not known to be true may be switched off. A loop between two robots that is in the files of both
    counts once.

    Args:
        folder: Holds `robotN` folders, itself or in its only folder.

    Raises:
        RecordingError: If there are no such files, or a line is not understood.
    """
    folder = _team_folder(Path(folder))
    files = sorted(folder.glob("robot*/measurements.csv"), key=_robot)
    rows = np.vstack([_measurements(path) for path in files])
    rows = rows[np.sort(np.unique(rows[:, :14], axis=0, return_index=True)[1])]
    robots = rows[:, [0, 2]].astype(np.int64)
    graph = PoseGraph(
        keys=np.empty(0, dtype=np.int64),
        poses=np.empty((0, 4, 4)),
        ends=(robots << ROBOT_SHIFT) + rows[:, [1, 3]].astype(np.int64),
        T_a_b=_transforms(rows),
        covariance=_covariances(rows),
        is_switchable=rows[:, 13] == 0,
        fixed=np.empty(0, dtype=np.int64),
    )
    names = {robot: f"{folder.name}/robot{robot}" for robot in np.unique(robots).tolist()}
    try:
        return map_of(graph, names, "kimera_multi")
    except RecordingError as error:
        raise RecordingError(f"{folder}: {error}") from error


def _team_folder(folder: Path) -> Path:
    if not folder.is_dir():
        raise RecordingError(f"{folder}: expected a folder with robot0, robot1 ... in it")
    inner = [path for path in sorted(folder.iterdir()) if path.is_dir()]
    candidates = [folder, *(inner if len(inner) == 1 else [])]
    for candidate in candidates:
        if any(candidate.glob("robot*/measurements.csv")):
            return candidate
    found = ", ".join(path.name for path in inner) or "no folders"
    raise RecordingError(f"{folder}: expected robot0/measurements.csv and so on, found {found}")


def _robot(path: Path) -> int:
    match = _FOLDER.match(path.parent.name)
    if match is None:
        raise RecordingError(f"{path.parent}: expected a folder named robot and a number")
    return int(match[1])


def _measurements(path: Path) -> FloatArray:
    """Return the numbers (M, 15) of a file."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    if not lines or lines[0].strip() != HEADER:
        raise RecordingError(f"{path}: expected the header {HEADER!r}, found {lines[:1]}")
    rows = np.empty((len(lines) - 1, 15))
    for row, line in enumerate(lines[1:]):
        try:
            rows[row] = [float(word) for word in line.split(",")]
            _check(rows[row])
        except ValueError as error:
            raise RecordingError(f"{path}, line {row + 2}: {error}") from error
    return rows


def _check(row: FloatArray) -> None:
    if not (np.isfinite(row).all() and row[4:8].any() and (row[11:13] > 0).all()):
        raise ValueError("expected finite numbers, a rotation and positive precisions")
    if (row[:4] != row[:4].round()).any() or (row[:4] < 0).any() or (row[:4:2] >= 128).any():
        raise ValueError("expected whole numbers of robots (below 128) and of poses")


def _transforms(rows: FloatArray) -> FloatArray:
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3] = rotation_from_quat_xyzw(rows[:, 4:8])
    T[:, :3, 3] = rows[:, 8:11]
    return T


def _covariances(rows: FloatArray) -> FloatArray:
    kappa, tau = rows[:, 11], rows[:, 12]
    variances = np.repeat(np.column_stack([1 / (2 * kappa), 1 / tau]), 3, axis=1)
    return np.asarray(variances[:, :, None] * np.eye(6))
