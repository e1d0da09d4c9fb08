"""Planes around a box that go on behind or below the object in it: floor, table, wall."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import BoolArray, FloatArray

_MAX_POINTS = 400
_NUM_TRIES = 100
_MIN_SHARE = 0.3  # of what is around, that a plane must hold
_MAX_PLANES = 2
_MIN_POINTS = 20


def behind_surround(points: FloatArray, around: FloatArray, margin_m: FloatArray) -> BoolArray:
    """Return which points (N, 3) lie on planes of what is around the box (M, 3), or behind them.

    Args:
        points: In the camera frame [m], whose origin is in front of any plane that it sees.
        around: The same, of the surroundings.
        margin_m: Shape (N,), so far before a plane a point is still on it.
    """
    is_behind = np.zeros(len(points), np.bool_)
    rows = np.linspace(0, len(around) - 1, min(len(around), _MAX_POINTS)).round().astype(np.int64)
    left = around[rows]
    needed = max(_MIN_POINTS, _MIN_SHARE * len(left))
    rng = np.random.default_rng(0)
    for _ in range(_MAX_PLANES):
        if len(left) < needed:
            break
        plane = _plane(left, float(np.median(margin_m)) if len(margin_m) else 0.0, rng)
        is_on = np.abs(left @ plane[:3] - plane[3]) < np.median(margin_m)
        if is_on.sum() < needed:
            break
        is_behind |= points @ plane[:3] > plane[3] - margin_m
        left = left[~is_on]
    return is_behind


def _plane(points: FloatArray, margin_m: float, rng: np.random.Generator) -> FloatArray:
    """Return the plane (4,) n, d with n @ p = d > 0 that most points lie on."""
    corners = points[rng.integers(len(points), size=(_NUM_TRIES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals, corners = normals[length > 1e-9] / length[length > 1e-9, None], corners[length > 1e-9]
    if not len(normals):
        return np.array([0.0, 0.0, 1.0, np.inf])
    distances = np.einsum("ki,ki->k", normals, corners[:, 0])
    counts = (np.abs(points @ normals.T - distances) < margin_m).sum(axis=0)
    best = int(counts.argmax())
    is_on = np.abs(points @ normals[best] - distances[best]) < margin_m
    middle = points[is_on].mean(axis=0)
    n = np.linalg.svd(points[is_on] - middle, full_matrices=False)[2][2]
    d = float(n @ middle)
    return np.append(n, d) if d > 0 else -np.append(n, d)
