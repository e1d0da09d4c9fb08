"""The planes that a robot knows, and which of them it sees again.

A piece of a plane belongs to a known plane that faces the same way, lies no further away, and whose outline it
overlaps: so two tables of one height stay two. The outline grows by what is seen.
Source: Trevor, Rogers, Christensen: Planar surface SLAM with 3D and 2D sensors, ICRA 2012.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapstream.operators.planes.plane_axes import slid_onto
from mapstream.operators.planes.seen_plane import (
    SeenPlane,
    angle_between,
    distance_between,
    overlap_of,
)
from mapstream.recordings.maps.hulls import convex_hull, moved_hull
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert

_SAME_RAD, _SAME_M = 0.05, 0.05  # pieces of one image so near each other are of one plane


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach:
    """How far a plane may be from where it is known."""

    angle_rad: float
    distance_m: float
    min_overlap: float  # of the smaller outline
    at_once: float  # share of angle and distance that counts for what was seen a moment ago
    full_after_m: float  # so much way later all of them counts: odometry drifts

    def share(self, path_m: float) -> float:
        """Return the share after a way."""
        return min(1.0, self.at_once + (1 - self.at_once) * path_m / self.full_after_m)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownPlane:
    """A plane, in the frame in which the robot knows where it is now."""

    name: str
    plane: SeenPlane
    seen_ns: int
    path_m: float  # the robot's way when it was seen last
    T_base_plane: FloatArray  # (4, 4) at that time


class KnownPlanes:
    """All planes seen so far."""

    def __init__(self, reach: Reach, prefix: str) -> None:
        self._reach, self._prefix = reach, prefix
        self.planes: list[KnownPlane] = []

    def see(
        self, stamp_ns: int, pieces: Sequence[SeenPlane], T_frame_base: FloatArray, path_m: float
    ) -> list[str]:
        """Return the name of each plane that is seen at one moment; those that nobody knows get one.

        Args:
            stamp_ns: Of the moment.
            pieces: Of planes, in the frame of the known ones.
            T_frame_base: The robot's pose (4, 4) there.
            path_m: The robot's way until then.
        """
        T_base_frame = invert(T_frame_base)
        rows = self._matches(pieces, path_m)
        names = []
        for number, (piece, row) in enumerate(zip(pieces, rows, strict=True)):
            if row < 0:
                self.planes.append(
                    KnownPlane(
                        name=f"{self._prefix}:{stamp_ns}:{number}",
                        plane=piece,
                        seen_ns=stamp_ns,
                        path_m=path_m,
                        T_base_plane=T_base_frame @ piece.T_frame_plane,
                    )
                )
                row = len(self.planes) - 1  # noqa: PLW2901  # the new one's
            else:
                plane = joined(self.planes[row].plane, piece)
                self.planes[row] = replace(
                    self.planes[row],
                    plane=plane,
                    seen_ns=stamp_ns,
                    path_m=path_m,
                    T_base_plane=T_base_frame @ plane.T_frame_plane,
                )
            names.append(self.planes[row].name)
        return names

    def move(self, T_frame_base_at: Callable[[int], FloatArray]) -> None:
        """Put each plane where it was seen last from, by the robot's poses (4, 4) at stamps as they are known now."""
        for row, known in enumerate(self.planes):
            moved = T_frame_base_at(known.seen_ns) @ known.T_base_plane
            self.planes[row] = replace(known, plane=replace(known.plane, T_frame_plane=moved))

    def _matches(self, pieces: Sequence[SeenPlane], path_m: float) -> list[int]:
        """Return the row of the plane that each piece is of, -1 for none; the best matches first.

        Pieces that are not of one plane do not match the same one: what lies on a table is not the table.
        """
        costs = [
            (cost, number, row)
            for number, piece in enumerate(pieces)
            for row, known in enumerate(self.planes)
            if (cost := self._cost(known, piece, path_m)) is not None
        ]
        rows, first_of = [-1] * len(pieces), dict[int, SeenPlane]()
        for _, number, row in sorted(costs):
            first = first_of.setdefault(row, pieces[number]) if rows[number] < 0 else None
            if first is not None and _is_same(first, pieces[number]):
                rows[number] = row
        return rows

    def _cost(self, known: KnownPlane, piece: SeenPlane, path_m: float) -> float | None:
        """Return how far a piece is from a plane, in units of the reach; None if it is out of reach."""
        share = self._reach.share(path_m - known.path_m)
        angle = angle_between(known.plane, piece) / self._reach.angle_rad
        distance = distance_between(known.plane, piece) / self._reach.distance_m
        if max(angle, distance) > share:
            return None
        if overlap_of(known.plane, piece) < self._reach.min_overlap:
            return None
        return angle + distance


def joined(known: SeenPlane, piece: SeenPlane) -> SeenPlane:
    """Return a plane where it was seen last, with an outline that holds both."""
    normal = piece.normal
    if piece.is_line:  # how the plane leans is known better than by the line
        slope = known.normal @ piece.along
        normal = known.normal - slope * piece.along
        normal = normal / np.linalg.norm(normal)
    T = slid_onto(known.T_frame_plane, normal, piece.middle)
    if known.is_line and piece.is_line:
        side = np.sign(known.along @ piece.along)
        T = slid_onto(_turned(T, side * piece.along), piece.normal, piece.middle)
    hull = np.concatenate([known.hull_m, moved_hull(invert(T) @ piece.T_frame_plane, piece.hull_m)])
    if known.is_line and piece.is_line:
        ends = np.array([[hull[:, 0].min(), 0.0], [hull[:, 0].max(), 0.0]])
        return SeenPlane(T, ends, is_line=True)
    return SeenPlane(T, convex_hull(hull))


def _turned(T_frame_plane: FloatArray, along: FloatArray) -> FloatArray:
    turned = T_frame_plane.copy()
    turned[:3, 0] = along
    return turned


def _is_same(a: SeenPlane, b: SeenPlane) -> bool:
    return a is b or (angle_between(a, b) < _SAME_RAD and distance_between(a, b) < _SAME_M)
