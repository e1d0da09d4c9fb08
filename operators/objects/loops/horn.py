"""The rigid motion between two sets of points that are known to be the same.

Source: Horn, "Closed-form solution of absolute orientation using unit quaternions", JOSA A 4(4), 1987.
"""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import rotation_from_quat_xyzw

_FLAT = 1e-6  # how thin points on a line are, in units of their length, for all that rounding does


def horn(a: FloatArray, b: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Return T_a_b (4, 4), by which the sum of `weights * |a - T_a_b b|^2` is smallest.

    Args:
        a: Points (N, 3) in frame a [m].
        b: The same points in frame b.
        weights: Shape (N,), positive; without, all are alike.

    Raises:
        EstimationError: If there are fewer than three points, or they lie on a line or in one place.
    """
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 3:
        raise EstimationError(
            f"Horn: expected two (N, 3) of the same points, found {a.shape}, {b.shape}"
        )
    for name, points in (("first", a), ("second", b)):
        thickness, length = spread(points)
        if len(points) < 3 or not thickness > _FLAT * length:
            raise EstimationError(
                f"Horn: the {len(points)} points of the {name} frame lie on a line"
                f" ({length:.3g} m long, {thickness:.3g} m thick), so nothing says how they are"
                " turned about it; three that form a triangle are needed"
            )
    aligned: FloatArray = alignments(a[None], b[None], weights)[0]
    return aligned


def spread(points: FloatArray) -> tuple[float, float]:
    """Return how far points (N, 3) lie from their line, and along it: root sums of squares [m]."""
    if not len(points):
        return 0.0, 0.0
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(sizes[1]) if len(sizes) > 1 else 0.0, float(sizes[0])


def alignments(a: FloatArray, b: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Return T_a_b (M, 4, 4) of M sets of points (M, N, 3) at once; sets on a line are not noticed."""
    w = np.ones(a.shape[1]) if weights is None else weights
    w = (w / w.sum())[:, None]
    middle_a, middle_b = (w * a).sum(axis=1), (w * b).sum(axis=1)
    # S[i, j] is the sum of b_i a_j; N is Horn's symmetric matrix of it, (w, x, y, z)
    S = np.swapaxes(w * (b - middle_b[:, None]), 1, 2) @ (a - middle_a[:, None])
    N = np.empty((len(a), 4, 4))
    trace = np.trace(S, axis1=1, axis2=2)
    skew = S - np.swapaxes(S, 1, 2)
    N[:, 0, 0] = trace
    N[:, 0, 1:] = N[:, 1:, 0] = np.stack([skew[:, 1, 2], skew[:, 2, 0], skew[:, 0, 1]], axis=1)
    N[:, 1:, 1:] = S + np.swapaxes(S, 1, 2) - trace[:, None, None] * np.eye(3)
    quat_wxyz = np.linalg.eigh(N)[1][:, :, -1]
    T = np.tile(np.eye(4), (len(a), 1, 1))
    T[:, :3, :3] = rotation_from_quat_xyzw(np.roll(quat_wxyz, -1, axis=1))
    T[:, :3, 3] = middle_a - np.einsum("mij,mj->mi", T[:, :3, :3], middle_b)
    return T
