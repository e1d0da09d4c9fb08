"""First guesses of poses and velocities that only an IMU leads to.

Where nothing but inertial measurements links two poses, a guess must begin at the newest optimised state,
since errors of attitude and velocity grow with the square of time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import gtsam
import numpy as np

from mapstream.operators.estimation.factors.inertial import bias_of
from mapstream.operators.estimation.keys import key_of
from mapstream.operators.estimation.noise import Factor
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import invert, so3_exp

_FIRST_VELOCITY_MPS = 50.0  # how fast a robot may be when it begins
_NUM_HEADINGS = 8
_POSE_KINDS = ("odometry", "wheel", "motion_model", "registration")


def with_known_biases(map_: Map, new_rows: IntArray) -> Map:
    """Return the map where new vertices of a mission have the biases of the one before, if they have none."""
    gyro, accel = map_.vertices.gyro_bias_radps.copy(), map_.vertices.accel_bias_mps2.copy()
    for mission in np.unique(map_.vertices.mission[new_rows]).tolist():
        rows = map_.vertices_of(mission)
        for at in np.flatnonzero(np.isin(rows[1:], new_rows)).tolist():
            before, row = rows[at : at + 2].tolist()
            if np.isnan(gyro[row]).any():
                gyro[row], accel[row] = gyro[before], accel[before]
    vertices = replace(map_.vertices, gyro_bias_radps=gyro, accel_bias_mps2=accel)
    return replace(map_, vertices=vertices)


def dead_reckoned(map_: Map, imu_factors: Mapping[int, Factor], new_rows: IntArray) -> Map:
    """Return the map with new vertices where their IMU edges lead to, unless another edge leads there.

    Args:
        map_: With all else in place.
        imu_factors: Of the new edges of kind imu, by row.
        new_rows: Of vertices.
    """
    edges, vertices = map_.edges, map_.vertices
    is_linked = np.isin(edges.kind, _POSE_KINDS) & np.isin(edges.vertex_b, new_rows)
    linked = set(edges.vertex_b[is_linked].tolist())
    poses, velocities = vertices.T_mission_base.copy(), vertices.velocity_mps.copy()
    T_map_mission = map_.missions.T_map_mission[vertices.mission]
    by_time = sorted(imu_factors, key=lambda row: int(vertices.stamp_ns[edges.vertex_b[row]]))
    for row in by_time:
        a, b = int(edges.vertex_a[row]), int(edges.vertex_b[row])
        if b not in new_rows or b in linked:
            continue
        R_map_mission = T_map_mission[a, :3, :3]
        velocity = np.nan_to_num(velocities[a])
        start = gtsam.NavState(gtsam.Pose3(T_map_mission[a] @ poses[a]), R_map_mission @ velocity)
        integral = imu_factors[row].preintegratedMeasurements()
        end = integral.predict(start, bias_of(map_, a).constant)
        poses[b] = invert(T_map_mission[b]) @ end.pose().matrix()
        velocities[b] = R_map_mission.T @ end.velocity()
    return replace(map_, vertices=replace(vertices, T_mission_base=poses, velocity_mps=velocities))


def first_velocity_prior(map_: Map, vertex: int) -> Factor:
    """Return a weak prior on the velocity of the vertex where inertial measurements begin."""
    velocity = np.nan_to_num(map_.vertices.velocity_mps[vertex])
    R_map_mission = map_.missions.T_map_mission[map_.vertices.mission[vertex], :3, :3]
    noise = gtsam.noiseModel.Isotropic.Sigma(3, _FIRST_VELOCITY_MPS)
    return gtsam.PriorFactorVector(key_of("velocity", vertex), R_map_mission @ velocity, noise)


def headings(map_: Map, mission: int, fixes: IntArray) -> Iterator[Map]:
    """Yield the map with one mission's poses along its position fixes, under several headings.

    The fixes say where the robot was, the IMU how it turned and where up is, but nothing how it headed at
    first. Each map is a start for an optimiser; the one with the least error is right.

    Args:
        map_: With attitudes from integrated rates.
        mission: Whose poses only an IMU links.
        fixes: Rows of its edges of kind position, all in one outer frame, at least two.
    """
    edges, vertices = map_.edges, map_.vertices
    rows = map_.vertices_of(mission)
    stamps_ns = vertices.stamp_ns[rows]
    fixes = fixes[np.argsort(vertices.stamp_ns[edges.vertex_a[fixes]])]
    since_s, at_s = (
        (stamps - stamps_ns[0]) / 1e9
        for stamps in (stamps_ns, vertices.stamp_ns[edges.vertex_a[fixes]])
    )
    p_frame = np.column_stack(
        [np.interp(since_s, at_s, edges.T_a_b[fixes, axis, 3]) for axis in range(3)]
    )
    velocity = np.gradient(p_frame, since_s, axis=0)
    T_map_base = map_.T_map_base(rows)
    frame = int(edges.frame[fixes[0]])
    for yaw in np.linspace(0, 2 * np.pi, _NUM_HEADINGS, endpoint=False):
        R = so3_exp([0.0, 0.0, yaw])
        T_frame_base = np.tile(np.eye(4), (len(rows), 1, 1))
        T_frame_base[:, :3, :3] = R @ T_map_base[:, :3, :3]
        T_frame_base[:, :3, 3] = p_frame
        T_map_frame = map_.frames.T_map_frame[frame] if frame >= 0 else np.eye(4)
        if frame >= 0 and not map_.frames.is_known[frame]:
            T_map_frame = T_map_base[0] @ invert(T_frame_base[0])
        yield _with_start(map_, rows, T_map_frame, T_frame_base, velocity)


def _with_start(
    map_: Map,
    rows: IntArray,
    T_map_frame: FloatArray,
    T_frame_base: FloatArray,
    velocity: FloatArray,
) -> Map:
    """Return the map with poses and velocities that are given in an outer frame, which lies there."""
    vertices = map_.vertices
    T_mission_map = invert(map_.missions.T_map_mission[vertices.mission[rows]])
    poses, velocities = vertices.T_mission_base.copy(), vertices.velocity_mps.copy()
    T_mission_frame = T_mission_map @ T_map_frame
    poses[rows] = T_mission_frame @ T_frame_base
    velocities[rows] = (T_mission_frame[:, :3, :3] @ velocity[:, :, None])[:, :, 0]
    frames = map_.frames.T_map_frame.copy()
    used = np.unique(map_.edges.frame[np.isin(map_.edges.vertex_a, rows)])
    unknown = [row for row in used.tolist() if row >= 0 and not map_.frames.is_known[row]]
    frames[unknown] = T_map_frame
    return replace(
        map_,
        vertices=replace(vertices, T_mission_base=poses, velocity_mps=velocities),
        frames=replace(map_.frames, T_map_frame=frames),
    )
