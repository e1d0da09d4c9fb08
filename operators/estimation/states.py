"""The variables of the problem as gtsam's values, and from there back into the map's tables.

What a vertex does not have (velocity and biases without an IMU) is absent from the problem, too.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from mapstream.operators.estimation.factors.mounts import mounts, with_mounts
from mapstream.operators.estimation.fixing import Fixable
from mapstream.operators.estimation.keys import Variable, key_of, rows_by_variable
from mapstream.operators.estimation.landmark_states import insert_landmarks, with_landmarks
from mapstream.operators.estimation.outer_frames import starting_frames
from mapstream.operators.estimation.vision import camera_states
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import invert, straightened

Values = Any  # gtsam has no types


def initial_values(map_: Map, keys: Iterable[int]) -> Values:
    """Return the map's present state of these variables.

    An unknown velocity is taken from the poses around it, an unknown bias is zero, an outer frame that was
    never found lies where its measurements agree best with the poses.
    """
    values = gtsam.Values()
    for variable, rows in rows_by_variable(keys).items():
        _INSERT[variable](map_, rows, values)
    return values


def with_solution(
    map_: Map, values: Values, held: Collection[int] = (), fix: Collection[Fixable] = ()
) -> Map:
    """Return the map with the state in these values; a guessed base frame moves with its first vertex.

    Args:
        map_: The map that the values came from.
        values: Of any of its variables; the others stay.
        held: Keys of variables that the solver did not move: their rows stay bit for bit.
        fix: What else stays: `base_frames`, the halves of extrinsics.
    """
    present = rows_by_variable(values.keys())
    moved = rows_by_variable(set(values.keys()) - set(held)) if held else present
    nothing = np.zeros(0, np.int64)
    before = map_
    map_ = _with_poses(map_, moved.get("pose", nothing), values, frames_stay="base_frames" in fix)
    map_ = _with_velocities(map_, moved.get("velocity", nothing), values)
    map_ = _with_biases(map_, moved.get("bias", nothing), values)
    landmarks = present.get("landmark", nothing)
    if held:  # a landmark that stays where it is moves in the base of a vertex that does not
        vertices = map_.landmarks.vertex[landmarks]
        is_carried = (map_.T_map_base(vertices) != before.T_map_base(vertices)).any(axis=(1, 2))
        landmarks = landmarks[is_carried | np.isin(landmarks, moved.get("landmark", nothing))]
    map_ = with_landmarks(map_, before, landmarks, values)
    map_ = _with_frames(map_, moved.get("frame", nothing), values)
    places = {
        row: values.atPose3(key_of("extrinsics", row)).matrix()
        for row in moved.get("extrinsics", nothing).tolist()
    }
    map_ = with_mounts(map_, places, fix) if places else map_
    return camera_states.with_refined_cameras(map_, values, moved, fix)


def _insert_poses(map_: Map, rows: IntArray, values: Values) -> None:
    _insert_each(values, "pose", rows, map_.T_map_base(rows))


def _insert_velocities(map_: Map, rows: IntArray, values: Values) -> None:
    velocities = map_.vertices.velocity_mps[rows]
    frames = map_.missions.T_map_mission[map_.vertices.mission[rows], :3, :3]
    in_map = np.einsum("nij,nj->ni", frames, velocities)
    is_unknown = ~np.isfinite(velocities).all(axis=1)
    if is_unknown.any():
        in_map[is_unknown] = velocities_of_poses(map_)[rows[is_unknown]]
    for row, velocity in zip(rows.tolist(), in_map, strict=True):
        values.insert(key_of("velocity", row), velocity)


def velocities_of_poses(map_: Map) -> FloatArray:
    """Return velocities (N, 3) in the map frame, as the poses before and after each vertex have it.

    A vertex alone in its mission stands still.
    """
    p = map_.T_map_base(np.arange(len(map_.vertices)))[:, :3, 3]
    velocities = np.zeros((len(p), 3))
    for mission in range(len(map_.missions)):
        rows = map_.vertices_of(mission)
        stamps_ns = map_.vertices.stamp_ns[rows]
        if len(rows) > 1 and (np.diff(stamps_ns) > 0).all():
            velocities[rows] = np.gradient(p[rows], (stamps_ns - stamps_ns[0]) / 1e9, axis=0)
    return velocities


def _insert_biases(map_: Map, rows: IntArray, values: Values) -> None:
    gyro = np.nan_to_num(map_.vertices.gyro_bias_radps[rows])
    accel = np.nan_to_num(map_.vertices.accel_bias_mps2[rows])
    for at, row in enumerate(rows.tolist()):
        values.insert(key_of("bias", row), gtsam.imuBias.ConstantBias(accel[at], gyro[at]))


def _insert_frames(map_: Map, rows: IntArray, values: Values) -> None:
    _insert_each(values, "frame", rows, starting_frames(map_, rows))


def _insert_mounts(map_: Map, rows: IntArray, values: Values) -> None:
    found = mounts(map_)
    poses = np.array([found[row].T_base_sensor for row in rows.tolist()]).reshape(-1, 4, 4)
    _insert_each(values, "extrinsics", rows, poses)


_INSERT: dict[Variable, Callable[[Map, IntArray, Values], None]] = {
    "pose": _insert_poses,
    "velocity": _insert_velocities,
    "bias": _insert_biases,
    "landmark": insert_landmarks,
    "frame": _insert_frames,
    "extrinsics": _insert_mounts,
    "camera": camera_states.insert_mounts,
    "intrinsics": camera_states.insert_intrinsics,
    "time_offset": camera_states.insert_time_offsets,
}


def _insert_each(values: Values, variable: Variable, rows: IntArray, poses: FloatArray) -> None:
    for row, pose in zip(rows.tolist(), poses, strict=True):
        values.insert(key_of(variable, row), gtsam.Pose3(pose))


def _with_poses(map_: Map, rows: IntArray, values: Values, *, frames_stay: bool) -> Map:
    """Return the map with new poses; what does not move keeps its bits, and its base frame."""
    if not len(rows):
        return map_
    poses = map_.T_map_base(np.arange(len(map_.vertices)))
    poses[rows] = poses_at(values, rows)
    moves = np.zeros(len(poses), bool)
    moves[rows] = True
    frames = map_.missions.T_map_mission.copy()
    is_guess = ~map_.missions.is_base_frame_known & (not frames_stay)
    for mission in np.flatnonzero(is_guess).tolist():
        vertices = map_.vertices_of(mission)
        if len(vertices) and moves[vertices[0]]:
            first = vertices[0]
            T_mission_base = map_.vertices.T_mission_base[first]
            frames[mission] = straightened(poses[first] @ invert(T_mission_base))
            moves[vertices] = True
    in_mission = map_.vertices.T_mission_base.copy()
    # Straightened, or errors would double with each update: a transpose is not an inverse then.
    T_mission_map = invert(frames)[map_.vertices.mission[moves]]
    in_mission[moves] = straightened(T_mission_map @ poses[moves])
    return replace(
        map_,
        missions=replace(map_.missions, T_map_mission=frames),
        vertices=replace(map_.vertices, T_mission_base=in_mission),
    )


def _with_velocities(map_: Map, rows: IntArray, values: Values) -> Map:
    if not len(rows):
        return map_
    in_map = np.array([values.atVector(key_of("velocity", row)) for row in rows.tolist()])
    frames = map_.missions.T_map_mission[map_.vertices.mission[rows], :3, :3]
    velocities = map_.vertices.velocity_mps.copy()
    velocities[rows] = np.einsum("nji,nj->ni", frames, in_map)
    return replace(map_, vertices=replace(map_.vertices, velocity_mps=velocities))


def _with_biases(map_: Map, rows: IntArray, values: Values) -> Map:
    if not len(rows):
        return map_
    gyro, accel = map_.vertices.gyro_bias_radps.copy(), map_.vertices.accel_bias_mps2.copy()
    for row in rows.tolist():
        bias = values.atConstantBias(key_of("bias", row))
        gyro[row], accel[row] = bias.gyroscope(), bias.accelerometer()
    vertices = replace(map_.vertices, gyro_bias_radps=gyro, accel_bias_mps2=accel)
    return replace(map_, vertices=vertices)


def _with_frames(map_: Map, rows: IntArray, values: Values) -> Map:
    if not len(rows):
        return map_
    frames = map_.frames.T_map_frame.copy()
    for row in rows.tolist():
        frames[row] = values.atPose3(key_of("frame", row)).matrix()
    return replace(map_, frames=replace(map_.frames, T_map_frame=frames))


def values_from(poses: FloatArray) -> Values:
    """Return values with a pose (4, 4) of each row, under the row's number."""
    values = gtsam.Values()
    _insert_each(values, "pose", np.arange(len(poses)), poses)
    return values


def poses_from(values: Values, num_poses: int) -> FloatArray:
    """Return poses (N, 4, 4) of the values under the keys 0 to N - 1, all of which must be there."""
    return _as_matrices(gtsam.utilities.extractPose3(values)[:num_poses])


def poses_at(values: Values, rows: IntArray) -> FloatArray:
    """Return poses (N, 4, 4) of vertices, all of which must be in the values."""
    if not len(rows):
        return np.zeros((0, 4, 4))
    present = rows_by_variable(values.keys())["pose"]
    found = _as_matrices(gtsam.utilities.extractPose3(values)[: len(present)])
    return found[np.searchsorted(present, rows)]


def _as_matrices(rows: FloatArray) -> FloatArray:
    """Return (N, 4, 4) of (N, 12): rotations by rows, then translations; gtsam sorts them by key."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = rows[:, 9:]
    return poses
