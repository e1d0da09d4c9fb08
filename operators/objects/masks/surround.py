"""Planes around a box that go on in it: floor, table, wall."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import BoolArray, FloatArray

_MAX_POINTS = 400
_NUM_TRIES = 100
_MIN_SHARE = 0.25  # of what is around and on no plane yet, that a plane must hold
_MAX_PLANES = 3
_MIN_POINTS = 20
_LEVEL = 0.87  # cosine of 30 degrees


def on_surround(
    points: FloatArray, around: FloatArray, margin_m: FloatArray, up: FloatArray | None = None
) -> BoolArray:
    """Return which points (N, 3) lie on planes that go through what is around the box (M, 3).

    What is behind such a plane stays: a table ends, and shows what stands beyond it.

    Args:
        points: In the camera frame [m].
        around: The same, of the surroundings.
        margin_m: Shape (N,), so far from a plane a point is still on it.
        up: A direction (3,), if only level planes count; None: walls do as well.
    """
    is_on = np.zeros(len(points), np.bool_)
    if not len(points):
        return is_on
    rows = np.linspace(0, len(around) - 1, min(len(around), _MAX_POINTS)).round().astype(np.int64)
    left, usual_m = around[rows], float(np.median(margin_m))
    rng = np.random.default_rng(0)
    for _ in range(_MAX_PLANES):
        if len(left) < _MIN_POINTS:
            break
        n, d = _plane(left, usual_m, rng, up)
        holds = np.abs(left @ n - d) < usual_m
        if holds.sum() < max(_MIN_POINTS, _MIN_SHARE * len(left)):
            break
        is_on |= np.abs(points @ n - d) < margin_m
        left = left[~holds]
    return is_on


def _plane(
    points: FloatArray, margin_m: float, rng: np.random.Generator, up: FloatArray | None
) -> tuple[FloatArray, float]:
    """Return the plane n @ p = d that most points lie on; d is infinite if there is none."""
    corners = points[rng.integers(len(points), size=(_NUM_TRIES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    is_good = length > 1e-9
    if up is not None:
        is_good &= np.abs(normals @ up) > _LEVEL * length
    if not is_good.any():
        return np.array([0.0, 0.0, 1.0]), np.inf
    normals, corners = normals[is_good] / length[is_good, None], corners[is_good]
    distances = np.einsum("ki,ki->k", normals, corners[:, 0])
    counts = (np.abs(points @ normals.T - distances) < margin_m).sum(axis=0)
    best = int(counts.argmax())
    own = points[np.abs(points @ normals[best] - distances[best]) < margin_m]
    middle = own.mean(axis=0)
    n: FloatArray = np.linalg.svd(own - middle, full_matrices=False)[2][2]
    return n, float(n @ middle)
