"""Planes: n.p + d = 0 in the map frame, and how a pose sees one.

In edges and in the table of landmarks a plane is a pose on it: z is its normal, the origin lies on it.
Of the covariance the rotations about x and y and the translation along z count; the rest slides along it.
Source: Trevor, Rogers, Christensen: Planar surface SLAM with 3D and 2D sensors, ICRA 2012.
"""

from __future__ import annotations

import gtsam
import numpy as np

from mapstream.operators.estimation.keys import key_of
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import so3_exp

_MEASURED = [0, 1, 5]  # of the tangent of a pose on the plane


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
    factors = {}
    for at, row in enumerate(rows.tolist()):
        covariance = edges.covariance[row][np.ix_(_MEASURED, _MEASURED)]
        plane = measured[at] * (1.0 if facing[at] >= 0 else -1.0)
        noise = noise_of(covariance, _by_factor(edges.T_a_b[row], plane))
        landmark = key_of("landmark", int(edges.landmark_a[row]))
        factors[row] = gtsam.OrientedPlane3Factor(plane, noise, int(edges.vertex_a[row]), landmark)
    return factors


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
