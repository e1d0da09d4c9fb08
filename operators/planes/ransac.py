"""Planes in a cloud without order: random samples, the plane with most points, the next one in what is left.

A point with its normal is a sample: one is enough for a plane. The points of a plane that do not hang together are
several pieces.
Source: Schnabel, Wahl, Klein: Efficient RANSAC for point-cloud shape detection, CGF 2007 (points with normals,
connected components in the plane's bitmap).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mapstream.operators.planes.oriented_points import OrientedPoints
from mapstream.operators.planes.plane_axes import pose_on
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

_REFITS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class RansacLimits:
    """What makes a plane."""

    distance_m: float  # of its points, at most
    angle_rad: float  # of their normals
    gap_m: float  # between points that hang together
    min_points: int
    min_area_m2: float
    max_planes: int
    num_samples: int


@dataclass(frozen=True, slots=True, eq=False)
class CloudPlane:
    """One piece of a plane."""

    T_frame_plane: FloatArray  # (4, 4) at the mean of its points
    points: FloatArray  # (N, 3) in the plane's axes


def cloud_planes(
    cloud: OrientedPoints, limits: RansacLimits, rng: np.random.Generator
) -> list[CloudPlane]:
    """Return pieces of planes, the plane with most points first."""
    found: list[CloudPlane] = []
    while len(cloud) >= limits.min_points and len(found) < limits.max_planes:
        pose = _best(cloud, limits, rng)
        is_on = _is_on(cloud, pose, limits)
        if is_on.sum() < limits.min_points:
            break
        inside = (cloud.points[is_on] - pose[:3, 3]) @ pose[:3, :3]
        for piece in _pieces(inside[:, :2], limits.gap_m):
            points = cloud.points[is_on][piece]
            if len(points) >= limits.min_points:
                found += _piece(points, pose[:3, 2], limits)
        cloud = cloud.chosen(~is_on)
    return found[: limits.max_planes]


def _best(cloud: OrientedPoints, limits: RansacLimits, rng: np.random.Generator) -> FloatArray:
    """Return a pose on the sampled plane with most points, fitted to them."""
    rows = rng.choice(len(cloud), min(limits.num_samples, len(cloud)), replace=False)
    normals = cloud.normals[rows]
    offsets = np.einsum("ni,ni->n", normals, cloud.points[rows])
    is_near = np.abs(cloud.points @ normals.T - offsets) < limits.distance_m
    is_on = is_near & (cloud.normals @ normals.T > np.cos(limits.angle_rad))
    best = rows[is_on.sum(axis=0).argmax()]
    pose = pose_on(cloud.normals[best], cloud.points[best])
    for _ in range(_REFITS):
        is_on_it = _is_on(cloud, pose, limits)
        if is_on_it.sum() < limits.min_points:
            break
        pose = fitted_pose(cloud.points[is_on_it], pose[:3, 2])
    return pose


def _is_on(cloud: OrientedPoints, pose: FloatArray, limits: RansacLimits) -> BoolArray:
    normal = pose[:3, 2]
    off = np.abs((cloud.points - pose[:3, 3]) @ normal)
    is_on: BoolArray = (off < limits.distance_m) & (
        cloud.normals @ normal > np.cos(limits.angle_rad)
    )
    return is_on


def fitted_pose(points: FloatArray, towards: FloatArray) -> FloatArray:
    """Return a pose (4, 4) on the least-squares plane of points (N, 3), its z on the side of `towards` (3,)."""
    middle = points.mean(axis=0)
    spread = points - middle
    _, axes = np.linalg.eigh(spread.T @ spread)
    normal = axes[:, 0] * np.sign(axes[:, 0] @ towards)
    return pose_on(normal, middle)


def _pieces(places_m: FloatArray, gap_m: float) -> list[IntArray]:
    """Return the rows of places (N, 2) that hang together: cells as large as the gap that touch."""
    cells = np.floor((places_m - places_m.min(axis=0)) / gap_m).astype(np.int64)
    image = np.zeros(cells.max(axis=0) + 1, np.uint8)
    image[cells[:, 0], cells[:, 1]] = 1
    count, labels = cv2.connectedComponents(image, connectivity=8)
    of_place = labels[cells[:, 0], cells[:, 1]]
    return [np.flatnonzero(of_place == label) for label in range(1, count)]


def _piece(points: FloatArray, towards: FloatArray, limits: RansacLimits) -> list[CloudPlane]:
    """Return the plane of points that hang together, if it is large enough."""
    pose = fitted_pose(points, towards)
    inside = (points - pose[:3, 3]) @ pose[:3, :3]
    hull = cv2.convexHull(inside[:, :2].astype(np.float32))
    return [CloudPlane(pose, inside)] if cv2.contourArea(hull) >= limits.min_area_m2 else []
