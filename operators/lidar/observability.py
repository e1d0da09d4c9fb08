"""What a registration could and could not observe: its information, and the directions that it leaves open.

At the solution each matched point tells the pose one number, its distance across the surface.
The Hessian of their squares is the information; a corridor's axis gets next to none, and what it gets is
the noise of estimated normals. Such a direction is left out, and its variance says so (`UNOBSERVED_VARIANCE`).
Source: Zhang, Kaess, Singh, On degeneracy of optimization-based state estimation problems, ICRA 2016;
Tuna et al., X-ICP, T-RO 2024; Censi, An accurate closed-form estimate of ICP's covariance, ICRA 2007 (its
first term).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import hat, symmetric
from mapstream.streams.messages.estimates import UNOBSERVED_VARIANCE

LEAST_SURPLUS = 3.0  # for normals of a map
_NOISE_FLOOR_M = 0.01  # of a range; simulated surfaces fit better than any real one
_IMPURE = (
    0.25  # of a unit vector whose turns count at the mean range; a smaller part of it is noise
)
_CORRELATION = 25.0  # neighbouring points share their errors: this many count as one
_NORMAL_ERROR_RAD = (
    0.05  # of an estimated normal: what it seems to see along its own surface is noise
)


@dataclass(frozen=True, slots=True, eq=False)
class Observability:
    """What points on planes say of a pose; tangent vectors have the rotation first [rad, m]."""

    information: FloatArray  # (6, 6), zero along the directions that are open
    covariance: FloatArray  # (6, 6), `UNOBSERVED_VARIANCE` along them
    variance: float  # [m^2] that one row of unit weight was taken to have
    unseen: FloatArray  # (K, 6) directions that are open, unit vectors
    seen_part: FloatArray  # (6, 6) takes a tangent vector to its part that is not open
    least_surplus: float  # over noise, in units of it, of the direction that shows the least

    def __post_init__(self) -> None:
        for name in ("information", "covariance", "unseen", "seen_part"):
            getattr(self, name).flags.writeable = False


def observability_of_planes(
    points: FloatArray,
    normals: FloatArray,
    rmse_m: float,
    weights: FloatArray | None = None,
    *,
    least_surplus: float = LEAST_SURPLUS,
) -> Observability:
    """Return what the distances of points from planes observe of the pose.

    Args:
        points: (N, 3) in the moving frame [m].
        normals: (N, 3) of the planes they lie on, turned into the moving frame.
        rmse_m: Of the distances across the planes.
        weights: (N,) how much each point counts; left out, all count alike.
        least_surplus: A direction that is observed shows so many times as much as noise of normals would, beyond it.

    Perturbation on the right: each row of the Jacobian is [p x n, n].
    """
    root = np.ones(len(points)) if weights is None else np.sqrt(weights)
    reach_m = float(np.sqrt(np.mean(np.sum(points**2, axis=1)))) if len(points) else 1.0
    reach_m = max(reach_m, 1e-3)
    scale = np.array([1 / reach_m] * 3 + [1.0] * 3)  # rotations as metres at the mean range
    jacobian = np.hstack([np.cross(points, normals), normals]) * scale * root[:, None]
    variance = _CORRELATION * max(rmse_m if np.isfinite(rmse_m) else 0.0, _NOISE_FLOOR_M) ** 2
    squares = jacobian.T @ jacobian
    noise = _seen_by_noise(points * root[:, None], root) * np.outer(scale, scale)
    surplus, axes = np.linalg.eigh(squares - noise)
    along = np.einsum("ik,ij,jk->k", axes, noise, axes)
    is_open = surplus <= least_surplus * along
    open_axes = _pure(axes.T[is_open])
    unseen = open_axes * scale
    unseen /= np.linalg.norm(unseen, axis=1, keepdims=True)
    variances = variance / np.where(is_open, np.inf, surplus)
    seen_part = np.eye(6) - open_axes.T @ open_axes
    units = np.outer(scale, scale)
    known = seen_part @ (axes * variances) @ axes.T @ seen_part
    covariance = known * units + UNOBSERVED_VARIANCE * unseen.T @ unseen
    return Observability(
        information=symmetric(seen_part @ squares @ seen_part / variance / units),
        covariance=symmetric(covariance),
        variance=variance,
        unseen=unseen,
        seen_part=scale[:, None] * seen_part / scale,
        least_surplus=float(np.min(surplus / np.maximum(along, np.finfo(float).tiny))),
    )


def _pure(axes: FloatArray) -> FloatArray:
    """Return orthonormal directions (K, 6) without the little of a turn that noise gives to shifts, and the reverse."""
    parts = axes.reshape(-1, 2, 3)
    share = np.linalg.norm(parts, axis=2, keepdims=True)
    pure = np.where(share < _IMPURE, 0.0, parts).reshape(-1, 6)
    return np.asarray(np.linalg.qr(pure.T)[0].T)


def covariance_of_planes(points: FloatArray, normals: FloatArray, rmse_m: float) -> FloatArray:
    """Return the covariance (6, 6) alone, of `observability_of_planes`."""
    return observability_of_planes(points, normals, rmse_m).covariance


def _seen_by_noise(points: FloatArray, root: FloatArray) -> FloatArray:
    """Return what normals of no use at all, but with the usual error, would add to the squares (6, 6).

    Both arguments carry the root of the points' weights: (N, 3) and (N,).
    """
    lever = hat(root @ points)
    rotation = np.sum(points**2) * np.eye(3) - points.T @ points
    noise: FloatArray = np.block([[rotation, lever], [lever.T, root @ root * np.eye(3)]])
    return _NORMAL_ERROR_RAD**2 * noise
