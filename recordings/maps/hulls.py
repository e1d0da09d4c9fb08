"""Outlines of planes: convex polygons in the x and y of a pose on the plane, as payloads of edges and landmarks."""

from __future__ import annotations

import json

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import FloatArray

_TOLERANCE_M = 0.01  # corners that stand out by less are left out
_MILLIMETRES = 3  # digits of a corner


def convex_hull(points: npt.NDArray[np.floating]) -> FloatArray:
    """Return the corners (K, 2) of the convex hull of points (N, 2) [m], counterclockwise.

    Points on a line have a hull of its two ends.
    """
    import cv2  # noqa: PLC0415  # a map is opened without it

    if len(points) < 2:
        return np.asarray(points, dtype=np.float64)
    centre = np.asarray(points).mean(axis=0)
    corners = cv2.convexHull((points - centre).astype(np.float32), clockwise=False).reshape(-1, 2)
    kept = cv2.approxPolyDP(corners, _TOLERANCE_M, closed=True).reshape(-1, 2)
    hull: FloatArray = (kept if len(kept) >= 3 else corners).astype(np.float64) + centre
    return hull


def hull_payload(hull_m: FloatArray) -> bytes:
    """Return the JSON of a hull (K, 2), to a millimetre."""
    return json.dumps({"hull": np.round(hull_m, _MILLIMETRES).tolist()}).encode()


def hull_of(payload: bytes) -> FloatArray:
    """Return the hull (K, 2) that a payload names; no corners where it names none."""
    try:
        hull = np.array(json.loads(payload or b"{}")["hull"], dtype=np.float64)
    except (ValueError, KeyError, TypeError):
        return np.empty((0, 2))
    is_hull = hull.ndim == 2 and hull.shape[1] in (2, 3) and bool(np.isfinite(hull).all())
    return hull[:, :2] if is_hull else np.empty((0, 2))


def moved_hull(T_a_b: FloatArray, hull_m: FloatArray) -> FloatArray:
    """Return a hull (K, 2) of a pose b on a plane in x and y of another, a: what stands out is left out."""
    moved: FloatArray = hull_m @ T_a_b[:2, :2].T + T_a_b[:2, 3]
    return moved
