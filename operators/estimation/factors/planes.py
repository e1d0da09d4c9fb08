"""Planes: n.p + d = 0 in the map frame, and how a pose sees one.

In edges and in the table of landmarks a plane is a pose on it: z is its normal, the origin lies on it.
Of the covariance the rotations about x and y and the translation along z count; the rest slides along it.
A wall that a planar laser saw as a line along x has no rotation about it: its factor has two errors instead of three.
Source: Trevor, Rogers, Christensen: Planar surface SLAM with 3D and 2D sensors, ICRA 2012.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np

from mapstream.operators.estimation.factors.own_factor import OwnFactor, Residual
from mapstream.operators.estimation.keys import key_of
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import hat, so3_exp

_MEASURED = [0, 1, 5]  # of the tangent of a pose on the plane
_AGAINST = np.diag([-1.0, 1.0])  # a turn about y takes the line out of the plane the other way


def coefficients(T_frame_plane: FloatArray) -> FloatArray:
    """Return normals and d (..., 4), with n.p + d = 0 in a frame, of poses (..., 4, 4) on planes."""
    normal = T_frame_plane[..., :3, 2]
    d = -np.einsum("...i,...i->...", normal, T_frame_plane[..., :3, 3])
    return np.concatenate([normal, d[..., None]], axis=-1)


def pose_on(plane: FloatArray, near: FloatArray) -> FloatArray:
    """Return the pose (4, 4) on a plane (4,) that is nearest to a pose (4, 4): turned and shifted least."""
    normal, z = plane[:3], near[:3, 2]
    axis, cosine = np.cross(z, normal), float(z @ normal)
    sine = float(np.linalg.norm(axis))
    turn = np.arctan2(sine, cosine) * axis / sine if sine > 0 else np.zeros(3)
    pose = near.copy()
    pose[:3, :3] = so3_exp(turn) @ near[:3, :3]
    pose[:3, 3] -= (normal @ near[:3, 3] + plane[3]) * normal
    return pose


def seen(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return factors on a pose and a plane: T_a_b is a pose on the plane, in the base frame.

    A normal that points to the other side than the landmark's is turned round.

    Raises:
        EstimationError: If a covariance is not one.
    """
    edges = map_.edges
    measured = coefficients(edges.T_a_b[rows])
    T_map_base = map_.T_map_base(edges.vertex_a[rows])
    known = coefficients(map_.T_map_landmark(edges.landmark_a[rows]))
    facing = np.einsum("ni,nij,nj->n", known[:, :3], T_map_base[:, :3, :3], measured[:, :3])
    factors: dict[int, Factor] = {}
    for at, row in enumerate(rows.tolist()):
        covariance = edges.covariance[row][np.ix_(_MEASURED, _MEASURED)]
        landmark = key_of("landmark", int(edges.landmark_a[row]))
        if np.isinf(covariance[0, 0]) and np.isfinite(covariance[1:, 1:]).all():
            ends = [int(edges.vertex_a[row]), landmark]
            noise = noise_of(covariance[1:, 1:], _AGAINST)
            factors[row] = OwnFactor(noise, ends, _line(edges.T_a_b[row]))
            continue
        plane = measured[at] * (1.0 if facing[at] >= 0 else -1.0)
        noise = noise_of(covariance, _by_factor(edges.T_a_b[row], plane))
        factors[row] = gtsam.OrientedPlane3Factor(plane, noise, int(edges.vertex_a[row]), landmark)
    return factors


def _line(T_base_line: FloatArray) -> Residual:
    """Return the residual of a line along x that lies in a plane: its slope against the plane, and its distance.

    It is exact however far the plane is tilted about the line, as where a laser leans that looks at an upright wall.
    """
    along, p = T_base_line[:3, 0], T_base_line[:3, 3]
    side = T_base_line[:3, 2]

    def residual(
        values: Any,  # noqa: ANN401
        keys: Sequence[int],
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        pose, plane = values.atPose3(keys[0]), values.atOrientedPlane3(keys[1])
        R, t = pose.rotation().matrix(), pose.translation()
        unit, d = plane.normal(), plane.planeCoefficients()[3]
        n = R.T @ unit.point3()  # in the base
        sign = 1.0 if n @ side >= 0 else -1.0
        if jacobians is not None:
            by_pose, by_plane = np.zeros((2, 6)), np.zeros((2, 3))
            by_pose[:, :3] = np.stack([along, p]) @ hat(n)
            by_pose[1, 3:] = n
            by_plane[:, :2] = np.stack([R @ along, R @ p + t]) @ unit.basis()
            by_plane[1, 2] = 1.0
            jacobians[0] = np.asfortranarray(sign * by_pose)
            jacobians[1] = np.asfortranarray(sign * by_plane)
        return sign * np.array([n @ along, n @ p + unit.point3() @ t + d])

    return residual


def _by_factor(T_base_plane: FloatArray, plane: FloatArray) -> FloatArray:
    """Return (3, 3): tilts about x and y and the shift along z of the pose on the plane, by gtsam's error.

    That error is minus the change of the normal in a basis that depends on the normal, and the change of d,
    which grows with the distance from the base to where on the plane the measurement was made.
    """
    R, t = T_base_plane[:3, :3], T_base_plane[:3, 3]
    side = np.sign(R[:, 2] @ plane[:3])
    normal_by_tilt = side * R[:, :2] @ np.array([[0.0, 1.0], [-1.0, 0.0]])  # (3, 2)
    factor_by_pose = np.zeros((3, 3))
    factor_by_pose[:2, :2] = -gtsam.Unit3(plane[:3]).basis().T @ normal_by_tilt
    factor_by_pose[2, :2] = -t @ normal_by_tilt
    factor_by_pose[2, 2] = -side
    return np.asarray(np.linalg.inv(factor_by_pose), dtype=np.float64)
