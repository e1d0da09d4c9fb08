"""The pose of one shape against others: patches onto planes, and edges onto lines, in one least squares.

A patch tells its distance across the plane, a point on an edge its two distances from the line. Robust weights
(Cauchy) keep what moved or was matched falsely from counting.
Source: Chen and Medioni, Object modelling by registration of multiple range images, 1992, for the planes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapstream.operators.odometry.rgbd.shape import Shape
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import hat, invert, se3_exp, straightened

_SEARCH_M = (0.2, 0.1, 0.05)  # how far apart what matches may lie, coarse to fine
_STEPS = 10  # at each
_SIGMA_M = 0.01  # of depth, from which on a match counts less
_LEAST_FACING = 0.8  # cosine between normals that match
_LEAST_ALONG = 0.9  # cosine between directions that match
_LINES_SHARE = 0.3  # what lines count for when patches count for 1
_DAMPING = 1e-4  # of the information: keeps what nothing observes where it was
_CORRELATION = 25.0  # neighbouring patches share their errors: this many count as one
_STILL = 1e-5  # a step so small is the last one
_LEAST_PATCHES = 50


@dataclass(frozen=True, eq=False)
class ShapeFit:
    """Where a shape lies."""

    T_world_camera: FloatArray  # (4, 4)
    covariance: FloatArray  # (6, 6) perturbed on the right, rotation first [rad, m]
    matched: float  # share of the shape's patches that lie on one of the others


def fit_shape(
    shape: Shape, others: Sequence[tuple[FloatArray, Shape]], guess: FloatArray
) -> ShapeFit:
    """Return the pose of a shape in the world.

    Args:
        shape: Of now.
        others: Poses (4, 4) in the world, and the shapes seen there.
        guess: The pose (4, 4) to begin at, at most a few decimetres off.

    Raises:
        EstimationError: If there are too few flat patches.
    """
    least = min([len(shape.points), *(len(other.points) for _, other in others)])
    if least < _LEAST_PATCHES:
        raise EstimationError(f"{least} flat patches in view, expected {_LEAST_PATCHES} or more")
    T, A, is_matched = guess, np.eye(6), np.zeros(len(shape.points), bool)
    for search_m in _SEARCH_M:
        for _ in range(_STEPS):
            A, g = _DAMPING * np.eye(6), np.zeros(6)
            is_matched = np.zeros(len(shape.points), bool)
            for T_world_other, other in others:
                T_other = invert(T_world_other) @ T
                on_planes = _planes(shape, other, T_other, search_m)
                on_lines = _lines(shape, other, T_other, search_m)
                A = A + (on_planes[0] + on_lines[0]) / len(others)
                g = g + (on_planes[1] + on_lines[1]) / len(others)
                is_matched |= on_planes[2]
            step = np.linalg.solve(A, g)
            T = straightened(T @ se3_exp(step))
            if np.linalg.norm(step) < _STILL:
                break
    covariance = np.linalg.inv(A) * _SIGMA_M**2 * _CORRELATION / len(shape.points)
    return ShapeFit(T, (covariance + covariance.T) / 2, float(is_matched.mean()))


def _planes(
    shape: Shape, other: Shape, T: FloatArray, search_m: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return what patches on planes say of the pose, perturbed on the right: (6, 6), (6,); which match (N,)."""
    moved = shape.points @ T[:3, :3].T + T[:3, 3]
    distance, row = other.patch_tree.query(moved, distance_upper_bound=search_m)
    near = np.flatnonzero(np.isfinite(distance))
    row = row[near]
    turned = other.normals[row] @ T[:3, :3]  # into the moving frame
    alike = np.einsum("ij,ij->i", turned, shape.normals[near]) > _LEAST_FACING
    near, row, turned = near[alike], row[alike], turned[alike]
    r = np.einsum("ij,ij->i", other.normals[row], other.points[row] - moved[near])
    weights = shape.weights[near] / (1 + (r / _SIGMA_M) ** 2)
    J = np.hstack([np.cross(shape.points[near], turned), turned])
    is_matched = np.zeros(len(moved), bool)
    is_matched[near] = True
    return (J * weights[:, None]).T @ J, J.T @ (weights * r), is_matched


def _lines(
    shape: Shape, other: Shape, T: FloatArray, search_m: float
) -> tuple[FloatArray, FloatArray]:
    """Return what edges on lines say of the pose, perturbed on the right: (6, 6), (6,)."""
    if len(shape.line_points) == 0 or len(other.line_points) == 0:
        return np.zeros((6, 6)), np.zeros(6)
    moved = shape.line_points @ T[:3, :3].T + T[:3, 3]
    distance, row = other.line_tree.query(moved, distance_upper_bound=search_m)
    near = np.flatnonzero(np.isfinite(distance))
    row = row[near]
    along = other.directions[row] @ T[:3, :3]  # in the moving frame
    alike = np.abs(np.einsum("ij,ij->i", along, shape.directions[near])) > _LEAST_ALONG
    near, row, along = near[alike], row[alike], along[alike]
    apart = (other.line_points[row] - moved[near]) @ T[:3, :3]
    across = np.eye(3) - along[:, :, None] * along[:, None]  # (E, 3, 3)
    r = np.einsum("eij,ej->ei", across, apart)
    weights = _LINES_SHARE / len(moved) / (1 + (r**2).sum(axis=1) / _SIGMA_M**2)
    J = across @ np.concatenate(
        [-hat(shape.line_points[near]), np.broadcast_to(np.eye(3), (len(near), 3, 3))], axis=2
    )
    weighted = J * weights[:, None, None]
    return np.einsum("eij,eik->jk", weighted, J), np.einsum("eij,ei->j", weighted, r)
