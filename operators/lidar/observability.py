"""What a registration could and could not observe: covariance from its Hessian.

At the solution each matched point tells the pose one number, its distance across the surface.
The Hessian of their squares is the information; a corridor's axis gets next to none.
Source: Censi, An accurate closed-form estimate of ICP's covariance, ICRA 2007 (its first term);
Zhang, Kaess, Singh, On degeneracy of optimization-based state estimation problems, ICRA 2016.
"""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import hat

_NOISE_FLOOR_M = 0.01  # of a range; simulated surfaces fit better than any real one
_CORRELATION = 25.0  # neighbouring points share their errors: this many count as one
_NORMAL_ERROR_RAD = (
    0.05  # of an estimated normal: what it seems to see along its own surface is noise
)
_MAX_SIGMA_M = 10.0  # of a direction that nothing observes


def covariance_of_planes(points: FloatArray, normals: FloatArray, rmse_m: float) -> FloatArray:
    """Return the covariance (6, 6) of a pose from points matched to planes.

    Args:
        points: (N, 3) in the moving frame [m].
        normals: (N, 3) of the planes they lie on, turned into the moving frame.
        rmse_m: Of the distances across the planes.

    Rotation first, perturbation on the right: each row of the Jacobian is [p x n, n].
    """
    reach_m = float(np.sqrt(np.mean(np.sum(points**2, axis=1)))) if len(points) else 1.0
    reach_m = max(reach_m, 1e-3)
    scale = np.array([1 / reach_m] * 3 + [1.0] * 3)  # rotations as metres at the mean range
    jacobian = np.hstack([np.cross(points, normals), normals]) * scale
    variance = _CORRELATION * max(rmse_m if np.isfinite(rmse_m) else 0.0, _NOISE_FLOOR_M) ** 2
    seen = jacobian.T @ jacobian - _seen_by_noise(points) * np.outer(scale, scale)
    information, axes = np.linalg.eigh(seen / variance)
    variances = 1 / np.maximum(information, 1 / _MAX_SIGMA_M**2)
    covariance: FloatArray = (axes * variances) @ axes.T * np.outer(scale, scale)
    return (covariance + covariance.T) / 2


def _seen_by_noise(points: FloatArray) -> FloatArray:
    """Return what normals of no use at all, but with the usual error, would add to the squares (6, 6)."""
    lever = hat(points.sum(axis=0))
    rotation = np.sum(points**2) * np.eye(3) - points.T @ points
    noise: FloatArray = np.block([[rotation, lever], [lever.T, len(points) * np.eye(3)]])
    return _NORMAL_ERROR_RAD**2 * noise
