"""Poses on planes, and how sure they are."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import symmetric


def pose_on(normal: FloatArray, point: FloatArray) -> FloatArray:
    """Return the pose (4, 4) on a plane at a point (3,): z is the unit normal (3,), x level, as far as it can be."""
    least = int(np.argmin(np.abs(normal)))
    ahead = np.cross(np.eye(3)[least], normal)
    x = ahead / np.linalg.norm(ahead)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([x, np.cross(normal, x), normal])
    pose[:3, 3] = point
    return pose


def plane_covariance(T_frame_plane: FloatArray, information: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of a pose on a plane, infinite where the plane says nothing.

    Args:
        T_frame_plane: Pose (4, 4) on it.
        information: Shape (3, 3), of q = -n / d of the plane n.p + d = 0.
    """
    R, p = T_frame_plane[:3, :3], T_frame_plane[:3, 3]
    normal = R[:, 2]
    d = -normal @ p
    by_motion = np.zeros((3, 3))  # of q, by turns about x and y and by a shift along z
    turned = np.column_stack([-R[:, 1], R[:, 0]])  # of the normal
    d_by_motion = np.array([*(-turned.T @ p), -1.0])
    by_motion[:, :2] = -turned / d
    by_motion += np.outer(normal, d_by_motion) / d**2
    covariance = np.diag(np.full(6, np.inf))
    measured = np.ix_([0, 1, 5], [0, 1, 5])
    inverse = np.linalg.inv(by_motion.T @ information @ by_motion).astype(np.float64)
    covariance[measured] = symmetric(inverse)
    return covariance


def slid_onto(T_frame_plane: FloatArray, normal: FloatArray, point: FloatArray) -> FloatArray:
    """Return a pose (4, 4) turned and shifted least, so that its z is a unit normal (3,) and a point (3,) is on its plane.

    The normal is less than a right angle away from z.
    """
    z, x = normal, T_frame_plane[:3, 0]
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    pose = T_frame_plane.copy()
    pose[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    pose[:3, 3] -= (z @ (pose[:3, 3] - point)) * z
    return pose
