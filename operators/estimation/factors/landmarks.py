"""Edges from a pose to a landmark: 3D points of any kind, vertical lines seen as 2D points, poses, and ranges.

Sources: Cramariuc et al., maplab 2.0, RA-L 2023, section III-A, eq. 1 (3D observations: the Euclidean distance);
Trevor et al., OmniMapper, ICRA 2014, section IV (2D points, 3D points, poses).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import gtsam
import numpy as np

from mapstream.operators.estimation.factors import planes
from mapstream.operators.estimation.factors.edge_ends import require_ends
from mapstream.operators.estimation.factors.mounts import MountOf
from mapstream.operators.estimation.factors.own_factor import OwnFactor
from mapstream.operators.estimation.factors.payloads import number_of, payloads
from mapstream.operators.estimation.keys import key_of
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray

Shape = Literal["point", "point2d", "pose", "plane"]
_FAR = 0.003  # sigma by range below which bearing and range are as good as the point


def shape_of(kind: str) -> Shape:
    """Return which variable a kind of landmark is; what has no shape of its own is a 3D point."""
    return kind if kind in ("point2d", "pose", "plane") else "point"  # type: ignore[return-value]  # one of them


def seen(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return factors on a pose and a landmark: T_a_b is T_base_landmark, as far as the landmark has a pose.

    Raises:
        EstimationError: If an edge has no landmark, or its covariance is not one.
    """
    edges = map_.edges
    require_ends(map_, rows, "vertex_a", "landmark_a")
    shapes = np.array([shape_of(kind) for kind in map_.landmarks.kind[edges.landmark_a[rows]]])
    factors = planes.seen(map_, rows[shapes == "plane"], noise_of)
    for row, shape in zip(rows.tolist(), shapes.tolist(), strict=True):
        pose, landmark = int(edges.vertex_a[row]), key_of("landmark", int(edges.landmark_a[row]))
        if shape == "pose" and np.isinf(np.diagonal(edges.covariance[row])[:3]).all():
            noise = noise_of(edges.covariance[row, 3:, 3:])
            factors[row] = OwnFactor(
                noise, [pose, landmark], _euclidean(edges.T_a_b[row], is_pose=True)
            )
        elif shape == "pose":
            measured, noise = gtsam.Pose3(edges.T_a_b[row]), noise_of(edges.covariance[row])
            factors[row] = gtsam.BetweenFactorPose3(pose, landmark, measured, noise)
        elif shape == "point2d":
            noise = noise_of(edges.covariance[row, 3:5, 3:5])
            measured_xy = edges.T_a_b[row, :2, 3]
            factors[row] = OwnFactor(noise, [pose, landmark], _vertical_line(measured_xy))
        elif shape == "point":
            factors[row] = _point(map_, row, noise_of)
    return factors


def _point(map_: Map, row: int, noise_of: NoiseModels) -> Factor:
    """Return the factor of a 3D point, seen in the base frame: the Euclidean distance in units of its sigma.

    Where sigma is small against the range, gtsam's bearing and range stand for the point: both errors together
    are the Euclidean one in other axes, at 1/20 of the cost; the Jacobian is off by error over range.
    """
    edges = map_.edges
    pose, landmark = int(edges.vertex_a[row]), key_of("landmark", int(edges.landmark_a[row]))
    R, p_base = edges.T_a_b[row, :3, :3], edges.T_a_b[row, :3, 3]
    covariance = edges.covariance[row, 3:, 3:]
    range_m = float(np.linalg.norm(p_base))
    if not np.diagonal(covariance).max() < (_FAR * range_m) ** 2:
        return OwnFactor(noise_of(covariance), [pose, landmark], _euclidean(edges.T_a_b[row]))
    bearing = gtsam.Unit3(p_base)
    point_by_factor = np.column_stack([range_m * bearing.basis(), p_base / range_m])
    noise = noise_of(covariance, R.T @ point_by_factor)
    return gtsam.BearingRangeFactor3D(pose, landmark, bearing, range_m, noise)


def _euclidean(T_base_point: FloatArray, *, is_pose: bool = False) -> Any:  # noqa: ANN401
    """Return the residual of a point, or of a landmark with an orientation of which only the place was seen."""
    R, t = T_base_point[:3, :3], T_base_point[:3, 3]

    def residual(
        values: Any,  # noqa: ANN401
        keys: Sequence[int],
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        by_pose, by_point = np.zeros((3, 6), order="F"), np.zeros((3, 3), order="F")
        landmark = values.atPose3(keys[1]) if is_pose else None
        point = landmark.translation() if landmark else values.atPoint3(keys[1])
        predicted = values.atPose3(keys[0]).transformTo(point, by_pose, by_point)
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(R.T @ by_pose)
            if landmark:  # it moves along its own axes
                by_point = np.hstack([np.zeros((3, 3)), by_point @ landmark.rotation().matrix()])
            jacobians[1] = np.asfortranarray(R.T @ by_point)
        error: FloatArray = R.T @ (predicted - t)
        return error

    return residual


def _vertical_line(measured_xy: FloatArray) -> Any:  # noqa: ANN401
    """Return the residual of a line along the map's z axis, seen where it crosses the x-y plane of the base.

    So a corner in a planar scan constrains x, y and yaw, and a tilted base sees it in the right place.
    """

    def residual(
        values: Any,  # noqa: ANN401
        keys: Sequence[int],
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        pose = values.atPose3(keys[0])
        R, t, x_y = pose.rotation().matrix(), pose.translation(), values.atPoint2(keys[1])
        up = R[2]  # of the map, in the base: the line's direction
        height = -(R[:2, 2] @ (x_y - t[:2])) / up[2]  # above the base, where the line crosses
        by_pose, by_point = np.zeros((3, 6), order="F"), np.zeros((3, 3), order="F")
        point = pose.transformTo(np.array([*x_y, t[2] + height]), by_pose, by_point)
        if jacobians is not None:  # the crossing moves along the line so that z stays zero
            along = np.column_stack([np.eye(2), -up[:2] / up[2]])
            jacobians[0] = np.asfortranarray(along @ by_pose)
            jacobians[1] = np.asfortranarray(along @ by_point[:, :2])
        error: FloatArray = point[:2] - measured_xy
        return error

    return residual


def distance(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return factors on the distance from a sensor to a landmark, or to the base of another vertex.

    The payload has "range_m". The variance [m^2] is the first of the translations.

    Raises:
        EstimationError: If the payload has no range, an end is missing, or the variance is not one.
    """
    edges, given, mount_of = map_.edges, payloads(map_, rows), MountOf(map_)
    require_ends(map_, rows, "vertex_a")
    require_ends(map_, rows[edges.vertex_b[rows] < 0], "landmark_a")
    factors = {}
    for row, payload in given.items():
        pose, other = int(edges.vertex_a[row]), int(edges.vertex_b[row])
        range_m = float(number_of(map_, row, payload, "range_m", 1)[0])
        noise = noise_of(edges.covariance[row, 3:4, 3:4])
        T_base_sensor, _ = mount_of(pose, payload)
        sensor = gtsam.Pose3(T_base_sensor)
        make: Any = gtsam.RangeFactorWithTransformPose3
        if other < 0:
            make = gtsam.RangeFactorWithTransform3D
            other = key_of("landmark", int(edges.landmark_a[row]))
        factors[row] = make(pose, other, range_m, noise, sensor)
    return factors
