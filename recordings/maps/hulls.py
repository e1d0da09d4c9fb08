"""Outlines of planes: convex polygons in the x and y of a pose on the plane, as payloads of edges and landmarks."""

from __future__ import annotations

import json
from collections.abc import Mapping

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


def hull_payload(hull_m: FloatArray, more: Mapping[str, object] | None = None) -> bytes:
    """Return the JSON of a hull (K, 2), to a millimetre, and of what else is said of the plane."""
    return json.dumps({**(more or {}), "hull": np.round(hull_m, _MILLIMETRES).tolist()}).encode()


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


def area_of(hull_m: FloatArray) -> float:
    """Return the area [m^2] of a hull (K, 2)."""
    return abs(_signed_area(hull_m))


def common_area_of(a_m: FloatArray, b_m: FloatArray) -> float:
    """Return the area [m^2] that lies in two hulls (K, 2) and (M, 2), by cutting one at each side of the other.

    `cv2.intersectConvexConvex` finds nothing in common where corners or sides nearly meet.
    Source: Sutherland, Hodgman: Reentrant polygon clipping, CACM 1974.
    """
    ways_round = np.sign(_signed_area(a_m))
    rest = b_m
    for corner, following in zip(a_m, np.roll(a_m, -1, axis=0), strict=True):
        side = following - corner
        left = np.array([-side[1], side[0]]) * ways_round
        inward = (rest - corner) @ left  # how far inside, in units of the side's length
        rest = _cut(rest, inward)
        if len(rest) < 3:
            return 0.0
    return area_of(rest) if len(a_m) > 2 else 0.0


def _cut(hull: FloatArray, inward: FloatArray) -> FloatArray:
    """Return the part (K, 2) of a hull whose corners are inside, and where its sides cross the border."""
    kept = list[FloatArray]()
    for row, corner in enumerate(hull):
        before, now = inward[row - 1], inward[row]
        if before * now < 0:
            kept.append(hull[row - 1] + before / (before - now) * (corner - hull[row - 1]))
        if now >= 0:
            kept.append(corner)
    return np.array(kept).reshape(-1, 2)


def _signed_area(hull: FloatArray) -> float:
    if len(hull) < 3:
        return 0.0
    x, y = (hull - hull[0]).T
    return float(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))
