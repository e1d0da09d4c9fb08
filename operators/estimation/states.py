"""The variables of the problem as gtsam's values, and from there back into the map's tables.

What a vertex does not have (velocity and biases without an IMU) is absent from the problem, too.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from mapstream.operators.estimation.keys import Variable, key_of, rows_by_variable
from mapstream.recordings.maps.model import Map
from mapstream.streams.geometry import invert
from mapstream.streams.messages.sensors import FloatArray, IntArray

Values = Any  # gtsam has no types


def initial_values(map_: Map, keys: Iterable[int]) -> Values:
    """Return the map's present state of these variables.

    An unknown velocity is taken from the poses around it, an unknown bias is zero.
    """
    rows = rows_by_variable(keys)
    values = gtsam.Values()
    poses = rows.get("pose", np.zeros(0, np.int64))
    _insert_poses(values, poses, map_.T_map_base(poses))
    return values


def with_solution(map_: Map, values: Values, held: Collection[int] = ()) -> Map:
    """Return the map with the state in these values; a guessed base frame moves with its first vertex.

    Args:
        map_: The map that the values came from.
        values: Of any of its variables; the others stay.
        held: Keys of variables that the solver did not move: their rows stay bit for bit.
    """
    rows = rows_by_variable(set(values.keys()) - set(held))
    return _with_poses(map_, rows.get("pose", np.zeros(0, np.int64)), values)


def _with_poses(map_: Map, rows: IntArray, values: Values) -> Map:
    poses = map_.T_map_base(np.arange(len(map_.vertices)))
    poses[rows] = np.array([values.atPose3(row).matrix() for row in rows.tolist()]).reshape(
        -1, 4, 4
    )
    frames = map_.missions.T_map_mission.copy()
    for row in np.flatnonzero(~map_.missions.is_base_frame_known):
        vertices = map_.vertices_of(int(row))
        if len(vertices):
            first = vertices[0]
            frames[row] = poses[first] @ invert(map_.vertices.T_mission_base[first])
    in_mission = invert(frames)[map_.vertices.mission] @ poses
    return replace(
        map_,
        missions=replace(map_.missions, T_map_mission=frames),
        vertices=replace(map_.vertices, T_mission_base=in_mission),
    )


def _insert_poses(values: Values, rows: IntArray, poses: FloatArray, of: Variable = "pose") -> None:
    for row, pose in zip(rows.tolist(), poses, strict=True):
        values.insert(key_of(of, row), gtsam.Pose3(pose))


def values_from(poses: FloatArray) -> Values:
    """Return values with a pose (4, 4) of each row, under the row's number."""
    values = gtsam.Values()
    _insert_poses(values, np.arange(len(poses)), poses)
    return values


def poses_from(values: Values, num_poses: int) -> FloatArray:
    """Return poses (N, 4, 4) of the values under the keys 0 to N - 1, all of which must be there."""
    rows = gtsam.utilities.extractPose3(values)[:num_poses]  # (M, 12) by key: R by rows, then t
    poses = np.tile(np.eye(4), (num_poses, 1, 1))
    poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = rows[:, 9:]
    return poses
