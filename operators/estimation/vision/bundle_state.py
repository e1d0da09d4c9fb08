"""Where a bundle's poses, points and sensors are, taken from gtsam's values, and what it costs there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapstream.operators.estimation.states import Values, poses_at
from mapstream.operators.estimation.vision.bundle import Bundle, Sensor
from mapstream.operators.estimation.vision.schur import Blocks, pose_blocks, summed
from mapstream.operators.estimation.vision.sightings import (
    Residuals,
    SensorState,
    Sightings,
    chi2_and_weights,
    errors,
    residuals,
)
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.geometry import hat

Used = tuple[BoolArray, ...]  # by sightings: which observations (N,) take part


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Where everything in a bundle is."""

    poses: FloatArray  # (V, 4, 4)
    points: FloatArray  # (L, 3)
    sensors: tuple[SensorState, ...]


def state_of(bundle: Bundle, values: Values, points: FloatArray | None = None) -> State:
    """Return the state in gtsam's values; the points are given where they are not in these."""
    if points is None:
        points = np.array([values.atPoint3(key) for key in bundle.point_keys]).reshape(-1, 3)
    sensors = tuple(_sensor_state(sensor, values) for sensor in bundle.sensors)
    return State(poses_at(values, bundle.vertices), points, sensors)


def _sensor_state(sensor: Sensor, values: Values) -> SensorState:
    state = sensor.state
    if sensor.mount_key is not None:
        state = replace(state, T_base_sensor=values.atPose3(sensor.mount_key).matrix())
    if sensor.intrinsics_key is not None:
        state = state.with_intrinsics(values.atVector(sensor.intrinsics_key))
    if sensor.time_offset_key is not None:
        state = replace(state, time_offset_s=float(values.atVector(sensor.time_offset_key)[0]))
    return state


def in_vertices(bundle: Bundle, state: State) -> tuple[FloatArray, FloatArray]:
    """Return for each pair (P,) the rotation of its vertex, and the point in that vertex's base."""
    pairs = bundle.pairs
    R = state.poses[:, :3, :3][pairs.pose]
    away = state.points[pairs.point] - state.poses[pairs.pose, :3, 3]
    return R, np.einsum("nji,nj->ni", R, away)


def all_errors(bundle: Bundle, state: State) -> list[FloatArray]:
    """Return the errors (N, M) of each of the sightings, in units of standard deviations."""
    _, p_vertex = in_vertices(bundle, state)
    return [
        errors(seen, p_vertex[seen.pair], state.sensors[seen.sensor]) for seen in bundle.sightings
    ]


def plausible(bundle: Bundle, found: Sequence[FloatArray]) -> Used:
    """Return which observations fit so well that they may be true: in front of the sensor, within the gate."""
    pairs = zip(bundle.sightings, found, strict=True)
    return tuple(np.linalg.norm(each, axis=1) <= seen.gate for seen, each in pairs)  # NaN is not


def chi2_by_family(bundle: Bundle, found: Sequence[FloatArray], used: Used) -> dict[str, float]:
    """Return the costs of observations under their losses, as sums of squares."""
    sums: dict[str, float] = {}
    for seen, each, mask in zip(bundle.sightings, found, used, strict=True):
        cost, _ = chi2_and_weights(seen, each, mask)
        sums[seen.family] = sums.get(seen.family, 0.0) + float(cost.sum())
    return sums


def counts_by_family(bundle: Bundle, used: Used) -> dict[str, int]:
    """Return how many observations take part."""
    counts: dict[str, int] = {}
    for seen, mask in zip(bundle.sightings, used, strict=True):
        counts[seen.family] = counts.get(seen.family, 0) + int(mask.sum())
    return counts


def linearized(bundle: Bundle, state: State, used: Used) -> Blocks:
    """Return the normal equations of all that takes part."""
    R, p_vertex = in_vertices(bundle, state)
    num = len(p_vertex)
    information, gradient = np.zeros((num, 9)), np.zeros((num, 3))
    extras = []
    for seen, mask in zip(bundle.sightings, used, strict=True):
        found = residuals(seen, p_vertex[seen.pair], state.sensors[seen.sensor])
        _, weights = chi2_and_weights(seen, found.errors, mask)
        root = np.sqrt(weights)[:, None]
        takes_part = (weights > 0)[:, None]
        e = np.where(takes_part, found.errors, 0.0) * root
        A = np.where(takes_part[:, :, None], found.by_vertex_point, 0.0) * root[:, :, None]
        information += summed(seen.pair, np.einsum("nki,nkj->nij", A, A).reshape(-1, 9), num)
        gradient += summed(seen.pair, np.einsum("nki,nk->ni", A, e), num)
        if bundle.sensors[seen.sensor].keys:
            J = _by_sensor(bundle.sensors[seen.sensor], found)
            J = np.where(takes_part[:, :, None], J, 0.0) * root[:, :, None]
            extras.append((seen, J, np.swapaxes(A, 1, 2) @ J, e))
    blocks = pose_blocks(bundle.pairs, R, p_vertex, information.reshape(-1, 3, 3), gradient)
    return _with_sensors(bundle, blocks, (R, p_vertex), extras) if extras else blocks


def _by_sensor(sensor: Sensor, found: Residuals) -> FloatArray:
    """Return derivatives (N, M, B) by all that is refined of a sensor, in the order of its keys."""
    columns = []
    if sensor.mount_key is not None:
        columns.append(found.by_mount)
    if sensor.intrinsics_key is not None:
        columns.append(found.by_intrinsics)
    if sensor.time_offset_key is not None:
        columns.append(found.by_time_offset)
    return np.concatenate(columns, axis=2)


def extra_slices(bundle: Bundle) -> list[slice]:
    """Return where the variables of each sensor lie among those of all."""
    sizes = [_num_extra(sensor) for sensor in bundle.sensors]
    ends = np.cumsum(sizes).tolist()
    return [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]


def _num_extra(sensor: Sensor) -> int:
    camera = sensor.state.calibration
    intrinsics = 4 + (camera.xi is not None) + len(camera.distortion_parameters) if camera else 0
    is_on = (sensor.mount_key, sensor.intrinsics_key, sensor.time_offset_key)
    return sum(n for n, key in zip((6, intrinsics, 1), is_on, strict=True) if key is not None)


Extra = tuple[Sightings, FloatArray, FloatArray, FloatArray]
"""Sightings, derivatives by their sensor, these times those by the point, and errors."""


def _with_sensors(
    bundle: Bundle, blocks: Blocks, geometry: tuple[FloatArray, FloatArray], extras: list[Extra]
) -> Blocks:
    R, p_vertex = geometry
    pairs, slices = bundle.pairs, extra_slices(bundle)
    size = slices[-1].stop
    extra, gradient = np.zeros((size, size)), np.zeros(size)
    pose_extra = np.zeros((pairs.num_poses, 6, size))
    point_extra = np.zeros((pairs.num_points, 3, size))
    for seen, J, AtJ, e in extras:
        at = slices[seen.sensor]
        flat = J.reshape(-1, J.shape[2])
        extra[at, at] += flat.T @ flat
        gradient[at] += flat.T @ e.ravel()
        K = summed(seen.pair, AtJ, len(p_vertex))
        toward_pose = np.concatenate([-hat(p_vertex) @ K, -K], axis=1)  # G^T K
        pose_extra[:, :, at] += summed(pairs.pose, toward_pose, pairs.num_poses)
        point_extra[:, :, at] += summed(pairs.point, R @ K, pairs.num_points)
    return replace(
        blocks,
        extra=extra,
        extra_gradient=gradient,
        pose_extra=pose_extra,
        point_extra=point_extra,
    )


def rows_left_out(bundle: Bundle, used: Used) -> IntArray:
    """Return the map's observations that do not take part."""
    rows = [seen.rows[~mask] for seen, mask in zip(bundle.sightings, used, strict=True)]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *rows]))
