"""Covariances of motion: how those of steps add up, what was not measured of one, and what it is worth then."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.geometry import SE3, symmetric
from mapstream.streams.messages.estimates import UNOBSERVED_VARIANCE

OPEN_VARIANCE = (
    UNOBSERVED_VARIANCE / 100
)  # from which on a direction counts as not measured: parts of steps have less
UNMEASURED_SIGMAS = (0.5, 0.5, 0.5, 5.0, 5.0, 5.0)  # [rad, m] of a predicted step, per second
_DISTINCT = (
    0.3  # of two unit vectors the smaller singular value, from about 25 degrees between them on
)


def diagonal(sigma_rad: float, sigma_m: float) -> FloatArray:
    """Return the covariance (6, 6) of independent axes, rotation first."""
    return np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)


def unmeasured(duration_s: float) -> FloatArray:
    """Return the covariance (6, 6) of a step that only a motion model says (OmniMapper, section IV-D3)."""
    return np.diag(np.square(UNMEASURED_SIGMAS)) * max(duration_s, 0.1)


def chain(covariance: FloatArray, step: SE3, step_covariance: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of a motion followed by one more step.

    Perturbations are on the right, so what was uncertain before the step is seen from after it.
    """
    adjoint = step.inverse().adjoint()
    carried: FloatArray = adjoint @ covariance @ adjoint.T
    is_finite = np.isfinite(carried).all() and np.isfinite(step_covariance).all()
    if not is_finite or (is_whole(carried) and is_whole(step_covariance)):
        return carried + step_covariance
    return _with_common_directions(carried, step_covariance)


def _with_common_directions(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the sum of two finite covariances (6, 6) of which one or both have open directions.

    The same direction, found twice, is never quite the same; a plain sum would open what lies between the two.
    """
    open_a, open_b = open_directions(a), open_directions(b)
    _, sizes, directions = np.linalg.svd(np.vstack([open_a, open_b]), full_matrices=False)
    common = directions[sizes > _DISTINCT]
    parts = []
    for covariance, own in ((a, open_a), (b, open_b)):
        closed = np.eye(6) - own.T @ own
        parts.append(closed @ covariance @ closed)
    closed = np.eye(6) - common.T @ common
    total: FloatArray = closed @ sum(parts) @ closed + UNOBSERVED_VARIANCE * common.T @ common
    return total


def is_whole(covariances: FloatArray) -> BoolArray:
    """Return which covariances (..., 6, 6) have measured every direction."""
    largest = np.diagonal(covariances, axis1=-2, axis2=-1).max(axis=-1)
    return np.asarray(largest < OPEN_VARIANCE / covariances.shape[-1])


def open_directions(covariance: FloatArray) -> FloatArray:
    """Return the directions (K, 6) that a covariance (6, 6) says were not measured, orthonormal."""
    is_axis = ~np.isfinite(np.diagonal(covariance))
    axes = np.eye(len(covariance))[is_axis]
    if is_whole(covariance):
        return axes
    finite = np.where(is_axis[:, None] | is_axis, 0.0, covariance)
    variances, vectors = np.linalg.eigh(finite)
    return np.vstack([axes, vectors.T[variances >= OPEN_VARIANCE]])


def bridged(covariance: FloatArray, duration_s: float) -> FloatArray:
    """Return a covariance (6, 6) whose open directions are worth what a motion model says of them.

    For where no other sensor takes these directions, so that a path does not fall apart.
    """
    directions = open_directions(covariance)
    if not len(directions):
        return covariance
    is_axis = ~np.isfinite(np.diagonal(covariance))
    finite = np.where(is_axis[:, None] | is_axis, 0.0, covariance)
    closed = np.eye(len(covariance)) - directions.T @ directions
    along = directions.T @ directions @ unmeasured(duration_s) @ directions.T @ directions
    return symmetric(closed @ finite @ closed + along)
