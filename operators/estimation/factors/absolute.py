"""Edges that measure one pose, or one landmark, in an outer frame: motion capture, fiducials, satellites.

The outer frame is the map frame, one that is known to lie somewhere in it, or one that the solver finds.
The sensor sits somewhere on the base, which is known, or found as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from mapstream.operators.estimation.factors.edge_ends import edge_name, require_ends
from mapstream.operators.estimation.factors.landmarks import Shape, shape_of
from mapstream.operators.estimation.factors.mounts import MountOf
from mapstream.operators.estimation.factors.own_factor import OwnFactor, Residual
from mapstream.operators.estimation.factors.payloads import number_of, payloads
from mapstream.operators.estimation.keys import key_of
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3

_IDENTITY = np.eye(4)
_UP = gtsam.Unit3(np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """One edge, with what its ends are."""

    row: int
    key: int  # of the pose, or of the landmark
    is_landmark: bool
    T_map_frame: FloatArray
    frame_key: int | None  # where the frame is a variable
    T_base_sensor: FloatArray
    mount_key: int | None  # where that is one


def _measured(map_: Map, rows: IntArray, landmark: Shape | None = None) -> Iterator[_Measured]:
    """Yield the edges; on a landmark they may be if it has this shape, in a frame that is known.

    Raises:
        EstimationError: If an edge is on something else, or its payload is not one.
    """
    edges, frames = map_.edges, map_.frames
    on_landmarks = rows[edges.vertex_a[rows] < 0]
    _require_landmarks(map_, on_landmarks, landmark)
    mount_of = MountOf(map_)
    for row, payload in payloads(map_, rows).items():
        vertex, frame = int(edges.vertex_a[row]), int(edges.frame[row])
        is_landmark = vertex < 0
        T_base_sensor, mount_key = (_IDENTITY, None) if is_landmark else mount_of(vertex, payload)
        is_found = frame >= 0 and not frames.is_known[frame]
        yield _Measured(
            row=row,
            key=key_of("landmark", int(edges.landmark_a[row])) if is_landmark else vertex,
            is_landmark=is_landmark,
            T_map_frame=frames.T_map_frame[frame] if frame >= 0 else _IDENTITY,
            frame_key=key_of("frame", frame) if is_found else None,
            T_base_sensor=T_base_sensor,
            mount_key=mount_key,
        )


def _require_landmarks(map_: Map, rows: IntArray, shape: Shape | None) -> None:
    if shape is None:
        require_ends(map_, rows, "vertex_a")
    require_ends(map_, rows, "landmark_a")
    frames = np.append(map_.frames.is_known, True)  # -1 is the map frame itself
    for row in rows.tolist():
        found = shape_of(map_.landmarks.kind[map_.edges.landmark_a[row]])
        if found != shape or not frames[map_.edges.frame[row]]:
            raise EstimationError(
                f"{edge_name(map_, row)}: where a landmark is can be measured of a {shape}, in a frame that"
                f" is known; this is a {found} in frame {map_.edges.frame[row]}"
            )


def pose(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return factors on all six directions: T_a_b is T_frame_sensor.

    Raises:
        EstimationError: If an end, a covariance or a payload is not one.
    """
    factors = {}
    for m in _measured(map_, rows, "pose"):
        z, covariance = map_.edges.T_a_b[m.row], map_.edges.covariance[m.row]
        if m.mount_key is None:
            T_sensor_base = SE3(m.T_base_sensor).inverse()
            is_at_base = np.array_equal(m.T_base_sensor, _IDENTITY)
            noise = noise_of(covariance, None if is_at_base else T_sensor_base.adjoint())
            T_frame_base = z @ T_sensor_base.matrix
            factors[m.row] = _pose_of_base(m, T_frame_base, noise)
        else:
            factors[m.row] = _own(m, noise_of(covariance), _pose_residual(m, gtsam.Pose3(z)))
    return factors


def _pose_of_base(m: _Measured, T_frame_base: FloatArray, noise: Any) -> Factor:  # noqa: ANN401
    if m.frame_key is not None:
        return gtsam.BetweenFactorPose3(m.frame_key, m.key, gtsam.Pose3(T_frame_base), noise)
    return gtsam.PriorFactorPose3(m.key, gtsam.Pose3(m.T_map_frame @ T_frame_base), noise)


def position(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return factors on the position of the sensor: the translation of T_a_b, in the outer frame.

    What the covariance says of rotations is not looked at. The lever arm is that of T_base_sensor, so
    that rotations are observed through motion.

    Raises:
        EstimationError: If an end, a covariance or a payload is not one.
    """
    factors = {}
    for m in _measured(map_, rows, "point"):
        p_frame, covariance = map_.edges.T_a_b[m.row, :3, 3], map_.edges.covariance[m.row, 3:, 3:]
        R, t = m.T_map_frame[:3, :3], m.T_map_frame[:3, 3]
        turned = None if np.array_equal(R, np.eye(3)) else np.ascontiguousarray(R.T)
        lever = m.T_base_sensor[:3, 3]
        if m.frame_key is not None or m.mount_key is not None:
            residual = _position_residual(m, p_frame)
            factors[m.row] = _own(m, noise_of(covariance), residual)
        elif m.is_landmark:
            noise = noise_of(covariance, turned)
            factors[m.row] = gtsam.PriorFactorPoint3(m.key, R @ p_frame + t, noise)
        else:
            noise = noise_of(covariance, turned)
            factors[m.row] = gtsam.GPSFactorArm(m.key, R @ p_frame + t, lever, noise)
    return factors


def gravity(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return factors on roll and pitch: the payload's "up" (3,) is the map's z axis, seen by the sensor.

    The variance of the direction [rad^2] is the first of the covariance.

    Raises:
        EstimationError: If the payload has no direction, or the variance is not one.
    """
    factors = {}
    given = payloads(map_, rows)
    for m in _measured(map_, rows):
        up_base = m.T_base_sensor[:3, :3] @ number_of(map_, m.row, given[m.row], "up", 3)
        noise = noise_of(np.eye(2) * map_.edges.covariance[m.row, 0, 0])
        factors[m.row] = gtsam.AttitudeFactorPose3(m.key, _UP, noise, gtsam.Unit3(up_base))
    return factors


def fixed(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:  # noqa: ARG001
    """Return factors that hold poses exactly where T_a_b says."""
    exactly = gtsam.noiseModel.Constrained.All(6)
    return {
        m.row: _pose_of_base(
            m, map_.edges.T_a_b[m.row] @ SE3(m.T_base_sensor).inverse().matrix, exactly
        )
        for m in _measured(map_, rows)
    }


def _own(m: _Measured, noise: Any, residual: Residual) -> Factor:  # noqa: ANN401
    keys = [key for key in (m.key, m.frame_key, m.mount_key) if key is not None]
    return OwnFactor(noise, keys, residual)


@dataclass(frozen=True, slots=True, eq=False)
class _Chain:
    """T_frame_sensor as the variables have it, with its Jacobians (6, 6) on the right, by variable."""

    T_frame_sensor: Any
    by_key: dict[int, FloatArray]


def _chain(m: _Measured, values: Any) -> _Chain:  # noqa: ANN401
    T_map_frame = gtsam.Pose3(m.T_map_frame) if m.frame_key is None else values.atPose3(m.frame_key)
    mount = gtsam.Pose3(m.T_base_sensor) if m.mount_key is None else values.atPose3(m.mount_key)
    T_frame_sensor = T_map_frame.between(values.atPose3(m.key)).compose(mount)
    by_key = {m.key: mount.inverse().AdjointMap()}
    if m.frame_key is not None:
        by_key[m.frame_key] = -T_frame_sensor.inverse().AdjointMap()
    if m.mount_key is not None:
        by_key[m.mount_key] = np.eye(6)
    return _Chain(T_frame_sensor, by_key)


def _pose_residual(m: _Measured, measured: Any) -> Residual:  # noqa: ANN401
    def residual(
        values: Any,  # noqa: ANN401
        keys: Sequence[int],
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        chain = _chain(m, values)
        error = measured.between(chain.T_frame_sensor)
        if jacobians is not None:
            by_error = gtsam.Pose3.LogmapDerivative(error)
            for at, key in enumerate(keys):
                jacobians[at] = np.asfortranarray(by_error @ chain.by_key[key])
        logarithm: FloatArray = gtsam.Pose3.Logmap(error)
        return logarithm

    return residual


def _position_residual(m: _Measured, p_frame: FloatArray) -> Residual:
    def residual(
        values: Any,  # noqa: ANN401
        keys: Sequence[int],
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        chain = _chain(m, values)
        R = chain.T_frame_sensor.rotation().matrix()
        if jacobians is not None:
            for at, key in enumerate(keys):
                jacobians[at] = np.asfortranarray(R @ chain.by_key[key][3:])
        error: FloatArray = chain.T_frame_sensor.translation() - p_frame
        return error

    return residual
