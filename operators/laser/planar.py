"""Motion in the plane: poses as `[x, y, yaw]` (3,), tangents as `[yaw, x, y]` (3,) with the perturbation on the right.

The tangent keeps the order of SE3's, rotation first, so that its axes are 2, 3 and 4 of the (6,) tangent in space.
"""

from __future__ import annotations

from math import atan2, cos, sin

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3

AXES = np.array([2, 3, 4])  # yaw, x, y in the tangent of SE3


def rotation(yaw_rad: float) -> FloatArray:
    """Return the matrix (2, 2) of a turn."""
    return np.array([[cos(yaw_rad), -sin(yaw_rad)], [sin(yaw_rad), cos(yaw_rad)]])


def apply(pose: FloatArray, points: FloatArray) -> FloatArray:
    """Map points (N, 2) by a pose (3,)."""
    moved: FloatArray = points @ rotation(pose[2]).T + pose[:2]
    return moved


def perturbed(pose: FloatArray, tangent: FloatArray) -> FloatArray:
    """Return the pose moved by a small tangent on its right; the shift is taken along the old axes."""
    return np.append(pose[:2] + rotation(pose[2]) @ tangent[1:], pose[2] + tangent[0])


def difference(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the tangent with `perturbed(a, tangent) == b`, the turn within half a circle."""
    turn = (b[2] - a[2] + np.pi) % (2 * np.pi) - np.pi
    return np.append(turn, rotation(a[2]).T @ (b[:2] - a[:2]))


def flattened(T: SE3) -> FloatArray:
    """Return the part (3,) of a transform that lies in the plane."""
    matrix = T.matrix
    return np.array([matrix[0, 3], matrix[1, 3], atan2(matrix[1, 0], matrix[0, 0])])


def lifted(pose: FloatArray) -> SE3:
    """Return a planar pose (3,) as a transform."""
    matrix = np.eye(4)
    matrix[:2, :2], matrix[:2, 3] = rotation(pose[2]), pose[:2]
    return SE3(matrix)


def lifted_covariance(covariance: FloatArray, sigma_rad: float, sigma_m: float) -> FloatArray:
    """Return a covariance (3, 3) among the axes of space (6, 6): roll, pitch and z have the deviations given."""
    lifted = np.diag(np.square([sigma_rad] * 3 + [sigma_m] * 3))
    lifted[np.ix_(AXES, AXES)] = covariance
    return lifted
