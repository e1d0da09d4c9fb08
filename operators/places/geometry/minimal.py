"""Poses from three points each: of rays by Grunert's P3P, of 3D points by Umeyama's alignment; many at once.

Sources: Haralick et al., Review and analysis of solutions of the three point perspective pose estimation problem,
IJCV 1994 (Grunert, 1841); Umeyama, PAMI 1991.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray

_REAL = 1e-3  # the imaginary part of a root that two real ones became by rounding


@dataclass(frozen=True, slots=True, eq=False)
class P3P:
    """Poses that put three points onto three rays; there are up to four for each triple."""

    T_sensor_map: FloatArray  # (M, 4, 4)
    triple: IntArray  # (M,) of which triple each is


def p3p(rays: FloatArray, points_map: FloatArray) -> P3P:
    """Return the poses from which triples of points (S, 3, 3) [m] lie on triples of unit rays (S, 3, 3)."""
    sides = points_map[:, [1, 0, 0]] - points_map[:, [2, 2, 1]]
    a2, b2, c2 = (sides * sides).sum(axis=2).T
    cos_a, cos_b, cos_g = (rays[:, [1, 0, 0]] * rays[:, [2, 2, 1]]).sum(axis=2).T
    with np.errstate(divide="ignore", invalid="ignore"):  # degenerate triples have no root
        v, p = _ratios(a2 / b2, c2 / b2, cos_a, cos_b, cos_g)
        across = (p - 1) * v * v - 2 * p * cos_b[:, None] * v + 1 + p
        u = across / (2 * (cos_g[:, None] - v * cos_a[:, None]))
        near = np.sqrt(b2[:, None] / (1 + v * v - 2 * v * cos_b[:, None]))
    triple, root = np.nonzero(np.isfinite(near) & np.isfinite(u) & (v > 0) & (u > 0))
    factors = np.stack([np.ones_like(v), u, v], axis=2)[triple, root] * near[triple, root, None]
    return P3P(aligned(factors[:, :, None] * rays[triple], points_map[triple]), triple)


def _ratios(
    a: FloatArray, c: FloatArray, cos_a: FloatArray, cos_b: FloatArray, cos_g: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the ratios (S, 4) of the third distance to the first, NaN where not real, and (a - c) (S, 1)."""
    p, q = a - c, a + c
    quartic = np.stack(
        [
            (p - 1) ** 2 - 4 * c * cos_a**2,
            4 * (p * (1 - p) * cos_b - (1 - q) * cos_a * cos_g + 2 * c * cos_a**2 * cos_b),
            2
            * (
                p**2
                - 1
                + 2 * p**2 * cos_b**2
                + 2 * (1 - c) * cos_a**2
                - 4 * q * cos_a * cos_b * cos_g
                + 2 * (1 - a) * cos_g**2
            ),
            4 * (-p * (1 + p) * cos_b + 2 * a * cos_g**2 * cos_b - (1 - q) * cos_a * cos_g),
            (1 + p) ** 2 - 4 * a * cos_g**2,
        ],
        axis=1,
    )
    companion = np.zeros((len(a), 4, 4))
    companion[:, 0] = -quartic[:, 1:] / quartic[:, :1]
    companion[:, [1, 2, 3], [0, 1, 2]] = 1
    is_usable = np.isfinite(companion.reshape(-1, 16).sum(axis=1))
    roots = np.linalg.eigvals(np.where(is_usable[:, None, None], companion, 0.0))
    is_real = (np.abs(roots.imag) < _REAL) & is_usable[:, None]
    return np.where(is_real, roots.real, np.nan), p[:, None]


def aligned(points_a: FloatArray, points_b: FloatArray) -> FloatArray:
    """Return T_a_b (S, 4, 4) that lay sets of points (S, n, 3) onto each other, in least squares."""
    mean_a, mean_b = points_a.mean(axis=1), points_b.mean(axis=1)
    spread = np.swapaxes(points_a - mean_a[:, None], 1, 2) @ (points_b - mean_b[:, None])
    U, _, Vt = np.linalg.svd(spread)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    T = np.tile(np.eye(4), (len(points_a), 1, 1))
    T[:, :3, :3] = U @ Vt
    T[:, :3, 3] = mean_a - np.einsum("sij,sj->si", T[:, :3, :3], mean_b)
    return T
