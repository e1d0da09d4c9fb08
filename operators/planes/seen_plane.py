"""One piece of a plane at one moment, and whether it lies beside another: angle, distance and overlap.

A wall that a planar laser saw is a line: its slope against a plane counts, and its overlap is that along the line,
since it may well run below all that a camera saw of the wall.
Source: Trevor, Rogers, Christensen: Planar surface SLAM with 3D and 2D sensors, ICRA 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.recordings.maps.hulls import area_of, common_area_of, moved_hull
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert

_MOST_LEAN = float(np.cos(np.deg2rad(30)))  # of a plane about the line by which a laser saw it


@dataclass(frozen=True, slots=True, eq=False)
class SeenPlane:
    """A pose on a plane and the outline there."""

    T_frame_plane: FloatArray  # (4, 4) z is the normal, x along a line
    hull_m: FloatArray  # (K, 2)
    is_line: bool = False  # nobody knows how it is turned about x

    @property
    def along(self) -> FloatArray:
        """Return x (3,)."""
        return self.T_frame_plane[:3, 0]

    @property
    def normal(self) -> FloatArray:
        """Return z (3,)."""
        return self.T_frame_plane[:3, 2]

    @property
    def origin(self) -> FloatArray:
        """Return a point (3,) of it."""
        return self.T_frame_plane[:3, 3]

    @property
    def middle(self) -> FloatArray:
        """Return the mean (3,) of the corners."""
        middle: FloatArray = self.T_frame_plane[:3, :2] @ self.hull_m.mean(axis=0) + self.origin
        return middle


def angle_between(a: SeenPlane, b: SeenPlane) -> float:
    """Return the angle between two planes [rad], as far as both know it; pi where they face different ways."""
    if not (a.is_line or b.is_line):
        return float(np.arccos(np.clip(a.normal @ b.normal, -1, 1)))
    if a.normal @ b.normal < _MOST_LEAN:
        return float(np.pi)
    if a.is_line and b.is_line:
        return float(np.arccos(np.clip(abs(a.along @ b.along), 0, 1)))
    line, plane = (a, b) if a.is_line else (b, a)
    return float(np.arcsin(np.clip(abs(line.along @ plane.normal), 0, 1)))


def distance_between(a: SeenPlane, b: SeenPlane) -> float:
    """Return how far the middle of the second is from the plane of the first [m]; a line's plane is the other's."""
    normal = b.normal if a.is_line and not b.is_line else a.normal
    return float(abs(normal @ (b.middle - a.middle)))


def overlap_of(a: SeenPlane, b: SeenPlane) -> float:
    """Return what share of the smaller outline lies on the other one."""
    if a.is_line or b.is_line:
        along = a.along if a.is_line else b.along
        (a_low, a_high), (b_low, b_high) = (_extent(each, along) for each in (a, b))
        common = min(a_high, b_high) - max(a_low, b_low)
        return max(0.0, common) / max(min(a_high - a_low, b_high - b_low), 1e-9)
    outline = moved_hull(invert(a.T_frame_plane) @ b.T_frame_plane, b.hull_m)
    smaller = min(area_of(a.hull_m), area_of(outline))
    return common_area_of(a.hull_m, outline) / max(smaller, 1e-9)


def _extent(plane: SeenPlane, along: FloatArray) -> tuple[float, float]:
    corners = plane.hull_m @ (along @ plane.T_frame_plane[:3, :2]) + along @ plane.origin
    return float(corners.min()), float(corners.max())
