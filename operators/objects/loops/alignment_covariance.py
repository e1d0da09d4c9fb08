"""How sure a motion between two sets of points is, in closed form.

The motion is where a cost J is smallest, so its uncertainty follows from that of the points by the implicit
function theorem: cov(x) = (d2J/dx2)^-1 (d2J/dz dx) cov(z) (d2J/dz dx)^T (d2J/dx2)^-1.
Source: Prakhya, Bingbing, Rui, Lin: "A closed-form estimate of 3D ICP covariance", MVA 2015, for its cost
point to point. There the motion is three angles and a translation; here it is perturbed on the right.
"""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import hat, invert, symmetric


def alignment_covariance(
    T_a_b: FloatArray,
    a: FloatArray,
    b: FloatArray,
    covariances_a: FloatArray,
    covariances_b: FloatArray,
    weights: FloatArray | None = None,
) -> FloatArray:
    """Return the covariance (6, 6) of T_a_b that `horn` finds for points; rotation first, perturbed on the right.

    Args:
        T_a_b: What Horn's method returned (4, 4).
        a: Points (N, 3) in frame a [m].
        b: The same points in frame b.
        covariances_a: Of points a (N, 3, 3), in frame a [m^2].
        covariances_b: Of points b (N, 3, 3), in frame b.
        weights: Those that Horn's method was given (N,).

    Raises:
        EstimationError: If the points do not determine the motion.
    """
    w = np.ones(len(a)) if weights is None else weights
    T_b_a = invert(T_a_b)
    R_b_a = T_b_a[:3, :3]
    # with x = (rotation, translation), J = sum of w |exp(x) b - m|^2, where m is point a in frame b
    m = a @ R_b_a.T + T_b_a[:3, 3]
    covariances_m = R_b_a @ covariances_a @ R_b_a.T
    inverse = np.linalg.pinv(_curvature(b, m, w))
    if np.linalg.matrix_rank(inverse) < 6:
        raise EstimationError(
            f"the {len(a)} points of an alignment do not determine its six numbers"
        )
    eye = np.tile(np.eye(3), (len(b), 1, 1))
    by_b = w[:, None, None] * np.concatenate([hat(m), eye], axis=1)  # half of d2J/db dx, (N, 6, 3)
    by_m = -w[:, None, None] * np.concatenate([hat(b), eye], axis=1)
    spread = _propagated(by_b, covariances_b) + _propagated(by_m, covariances_m)
    covariance: FloatArray = symmetric(inverse @ spread @ inverse)
    return covariance


def _curvature(b: FloatArray, m: FloatArray, w: FloatArray) -> FloatArray:
    """Return half of d2J/dx2 (6, 6), with the terms that vanish only where the points fit exactly."""
    off = b - m
    skew = hat(b)
    outer = np.einsum("n,ni,nj->ij", w, off, b)
    H = np.zeros((6, 6))
    H[:3, :3] = np.einsum("n,nki,nkj->ij", w, skew, skew)
    H[:3, :3] += (outer + outer.T) / 2 - np.trace(outer) * np.eye(3)
    H[:3, 3:] = np.einsum("n,nij->ij", w, skew)
    H[3:, :3] = H[:3, 3:].T
    H[3:, 3:] = w.sum() * np.eye(3)
    return H


def _propagated(by_points: FloatArray, covariances: FloatArray) -> FloatArray:
    summed: FloatArray = np.einsum("nij,njk,nlk->il", by_points, covariances, by_points)
    return summed
