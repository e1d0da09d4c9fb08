"""The planes that a robot knows, and which of them it sees again.

A piece of a plane belongs to a known plane that faces the same way, lies no further away, and whose outline it
overlaps: so two tables of one height stay two. The outline grows by what is seen. Parts of one floor may be seen
before what lies between; they become one plane when a piece lies on both.
Source: Trevor, Rogers, Christensen: Planar surface SLAM with 3D and 2D sensors, ICRA 2012.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Moment:
    """When planes are seen, and from where."""

    stamp_ns: int
    path_m: float
    T_base_frame: FloatArray  # (4, 4)

    def known(self, name: str, plane: SeenPlane) -> KnownPlane:
        """Return a plane as seen now."""
        return KnownPlane(
            name=name,
            plane=plane,
            seen_ns=self.stamp_ns,
            path_m=self.path_m,
            T_base_plane=self.T_base_frame @ plane.T_frame_plane,
        )


class KnownPlanes:
    """All planes seen so far."""

    def __init__(self, reach: Reach, prefix: str) -> None:
        self._reach, self._prefix = reach, prefix
        self._known: dict[str, KnownPlane] = {}  # by name, the oldest first
        self._apart: set[frozenset[str]] = set()  # names of two that lay above each other at once

    @property
    def planes(self) -> list[KnownPlane]:
        """Return all, the oldest first."""
        return list(self._known.values())

    def see(
        self, stamp_ns: int, pieces: Sequence[SeenPlane], T_frame_base: FloatArray, path_m: float
    ) -> list[tuple[str, ...]]:
        """Return the name of each plane that is seen at one moment; those that nobody knows get one.

        After it stand the names of planes which the piece shows to be the same: these are not used again.

        Args:
            stamp_ns: Of the moment.
            pieces: Of planes, in the frame of the known ones.
            T_frame_base: The robot's pose (4, 4) there.
            path_m: The robot's way until then.
        """
        now = _Moment(stamp_ns=stamp_ns, path_m=path_m, T_base_frame=invert(T_frame_base))
        names = self._matches(pieces, path_m)
        for number, piece in enumerate(pieces):
            known = self._known.get(names[number])
            names[number] = names[number] or f"{self._prefix}:{stamp_ns}:{number}"
            plane = joined(known.plane, piece) if known else piece
            self._known[names[number]] = now.known(names[number], plane)
        self._set_apart(pieces, names)
        older = dict[str, str]()  # the names that stay, by those that go
        found = []
        for name, piece in zip(names, pieces, strict=True):
            name = older.get(name, name)  # noqa: PLW2901  # that it has now
            same = self._same(name, piece, path_m)
            self._make_one(name, same, now)
            older |= dict.fromkeys(same, same[0])
            found.append(same)
        return found

    def move(self, T_frame_base_at: Callable[[int], FloatArray]) -> None:
        """Put each plane where it was seen last from, by the robot's poses (4, 4) at stamps as they are known now."""
        for name, known in self._known.items():
            moved = T_frame_base_at(known.seen_ns) @ known.T_base_plane
            self._known[name] = replace(known, plane=replace(known.plane, T_frame_plane=moved))

    def _matches(self, pieces: Sequence[SeenPlane], path_m: float) -> list[str]:
        """Return the name of the plane that each piece is of, empty for none; the best matches first.

        Pieces that are not of one plane do not match the same one: what lies on a table is not the table.
        """
        costs = [
            (cost, number, name)
            for number, piece in enumerate(pieces)
            for name, known in self._known.items()
            if (cost := self._cost(known, piece, path_m)) is not None
        ]
        names, first_of = [""] * len(pieces), dict[str, SeenPlane]()
        for _, number, name in sorted(costs, key=lambda found: found[0]):
            first = None if names[number] else first_of.setdefault(name, pieces[number])
            if first is not None and _is_same(first, pieces[number]):
                names[number] = name
        return names

    def _set_apart(self, pieces: Sequence[SeenPlane], names: Sequence[str]) -> None:
        """Remember which planes lie above each other: a board before a wall is never the wall."""
        for (a, name), (b, other) in combinations(zip(pieces, names, strict=True), 2):
            if not _is_same(a, b) and overlap_of(a, b) >= self._reach.min_overlap:
                self._apart.add(frozenset((name, other)))

    def _same(self, name: str, piece: SeenPlane, path_m: float) -> tuple[str, ...]:
        """Return the names of all planes that a piece of one of them lies on, the oldest first.

        It lies as near to each as pieces of one image lie to each other, or less near as odometry drifts.
        """
        same = {name}
        for other, known in self._known.items():
            drift = self._reach.share(path_m - known.path_m) / self._reach.at_once
            if (
                _is_same(known.plane, piece, drift)
                and self._cost(known, piece, path_m) is not None
                and not any(frozenset((other, each)) in self._apart for each in same)
            ):
                same.add(other)
        return tuple(each for each in self._known if each in same)

    def _make_one(self, name: str, same: Sequence[str], now: _Moment) -> None:
        """Join planes under the oldest name, where the named one is now."""
        plane = self._known[name].plane
        for other in same:
            if other != name:
                plane = joined(self._known[other].plane, plane)
        kept, *gone = same
        self._known[kept] = now.known(kept, plane)
        for each in gone:
            del self._known[each]
            self._apart |= {pair - {each} | {kept} for pair in self._apart if each in pair}

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


def _is_same(a: SeenPlane, b: SeenPlane, drift: float = 1.0) -> bool:
    is_near = distance_between(a, b) < _SAME_M * drift
    return a is b or (is_near and angle_between(a, b) < _SAME_RAD * drift)
