"""The objects that a robot knows, and which of them it sees again.

What is written on a thing, or its tag, is its identity. Without one it is the thing that its track was, or the
nearest of its class, within a gate that grows with the way: odometry drifts. Where two may be meant, none is.
Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section IV (object plugins).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """How far an object may be from where it is known."""

    at_once_m: float  # if it was seen a moment ago
    per_m: float  # more for each metre of way since
    most_m: float
    ambiguity: float  # the second nearest must be so many times as far

    def reach_m(self, path_m: float) -> float:
        """Return the largest distance after a way."""
        return min(self.at_once_m + self.per_m * path_m, self.most_m)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenObject:
    """What is seen of an object at one moment."""

    label: str  # its class
    p_frame: FloatArray  # (3,) its centre [m]
    text: str = ""  # an identity
    track: tuple[str, int] | None = None  # sensor and number
    is_oriented: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownObject:
    """A thing, in the frame in which the robot knows where it is now."""

    name: str
    label: str
    has_text: bool  # which is its name
    is_pose: bool  # its landmark has an orientation
    p_frame: FloatArray  # (3,) [m]
    seen_ns: int
    path_m: float  # the robot's way when it was seen last
    p_base: FloatArray  # (3,) at that time [m]


class KnownObjects:
    """All objects seen so far."""

    def __init__(self, gate: Gate, prefix: str) -> None:
        self._gate, self._prefix = gate, prefix
        self._known: dict[str, KnownObject] = {}  # by name, the oldest first
        self._of_track: dict[tuple[str, int], str] = {}  # names
        self._common: set[str] = set()  # texts that are on several things
        self._together: set[frozenset[str]] = set()  # names of two that were seen at once
        self._also: dict[str, list[KnownObject]] = {}  # what else a thing was, until it is seen

    @property
    def objects(self) -> list[KnownObject]:
        """Return all, the oldest first."""
        return list(self._known.values())

    def see(
        self, stamp_ns: int, objects: Sequence[SeenObject], T_frame_base: FloatArray, path_m: float
    ) -> list[tuple[KnownObject, ...]]:
        """Return which object each one is that is seen at one moment; none where two may be meant.

        What turns out to be one with another one that was known is both, once; after that it is the first.

        Args:
            stamp_ns: Of the moment.
            objects: In the frame of the known ones.
            T_frame_base: The robot's pose (4, 4) there.
            path_m: The robot's way until then.
        """
        texts = self._identities(objects)
        names = self._claimed(objects, texts)
        unsure = self._find(objects, names, path_m)
        T_base_frame = invert(T_frame_base)
        found: list[tuple[KnownObject, ...]] = []
        for row, (seen, text) in enumerate(zip(objects, texts, strict=True)):
            if row in unsure:
                found.append(())
                continue
            name = names[row] or f"{self._prefix}:{stamp_ns}:{row}"
            before = self._known.get(name)
            self._known[name] = KnownObject(
                name=name,
                label=seen.label,
                has_text=bool(text) or (before is not None and before.has_text),
                is_pose=before.is_pose if before else seen.is_oriented,
                p_frame=seen.p_frame,
                seen_ns=stamp_ns,
                path_m=path_m,
                p_base=T_base_frame[:3, :3] @ seen.p_frame + T_base_frame[:3, 3],
            )
            if seen.track is not None:
                self._follow(seen.track, name)
            found.append((self._known[name], *self._also.pop(name, ())))
        seen_now = [same[0].name for same in found if same]
        self._together |= {frozenset(pair) for pair in combinations(seen_now, 2)}
        return found

    def move(self, T_frame_base_at: Callable[[int], FloatArray]) -> None:
        """Put each object where it was seen last from, by the robot's poses (4, 4) at stamps as they are known now.

        What so comes to lie in one place is one thing, which the next sighting measures.
        """
        for name, known in self._known.items():
            T = T_frame_base_at(known.seen_ns)
            self._known[name] = replace(known, p_frame=T[:3, :3] @ known.p_base + T[:3, 3])
        pairs = [(_distance_m(*pair), *pair) for pair in combinations(self.objects, 2)]
        reach_m = self._gate.at_once_m / self._gate.ambiguity
        for _, older, younger in sorted((p for p in pairs if p[0] < reach_m), key=lambda p: p[0]):
            if self._may_be_one(older, younger):
                stays, goes = (younger, older) if younger.has_text else (older, younger)
                self._make_one(stays.name, goes)

    def _may_be_one(self, a: KnownObject, b: KnownObject) -> bool:
        are_known = {a.name, b.name} <= self._known.keys()
        are_alike = a.label == b.label and not (a.has_text and b.has_text)
        return are_known and are_alike and frozenset((a.name, b.name)) not in self._together

    def _make_one(self, name: str, goes: KnownObject) -> None:
        """Forget an object that is one of another name."""
        del self._known[goes.name]
        self._also.setdefault(name, []).extend((goes, *self._also.pop(goes.name, ())))
        self._of_track |= {track: name for track, of in self._of_track.items() if of == goes.name}
        self._together |= {
            pair - {goes.name} | {name} for pair in self._together if goes.name in pair
        }

    def _follow(self, track: tuple[str, int], name: str) -> None:
        """Note what a track is of; what it was before it showed its text is the same."""
        before = self._known.get(self._of_track.get(track, name))
        self._of_track[track] = name
        if before is not None and before.name != name and not before.has_text:
            self._make_one(name, before)

    def _identities(self, objects: Sequence[SeenObject]) -> list[str]:
        """Return the text of each object; what is on two things at once identifies neither, for good."""
        counts = Counter(seen.text for seen in objects if seen.text)
        self._common |= {text for text, count in counts.items() if count > 1}
        return ["" if seen.text in self._common else seen.text for seen in objects]

    def _claimed(self, objects: Sequence[SeenObject], texts: Sequence[str]) -> list[str]:
        """Return the names that texts and tracks give, each once; empty for none."""
        names, taken = list(texts), set(texts)
        for row, seen in enumerate(objects):
            of_track = "" if seen.track is None else self._of_track.get(seen.track, "")
            if not names[row] and of_track not in taken:
                names[row] = of_track
                taken.add(of_track)
        return names

    def _find(self, objects: Sequence[SeenObject], names: list[str], path_m: float) -> set[int]:
        """Give the objects that have no name that of the nearest of their class; return those that may be two.

        The nearest come first, so that what is sure takes its names out of the others' choice.
        """
        near: dict[int, dict[str, float]] = {}  # distances by row and name
        for row, seen in enumerate(objects):
            if not names[row]:
                near[row] = dict(self._near(seen, path_m))
        unsure = set()
        pairs = [(distance, row, name) for row, of in near.items() for name, distance in of.items()]
        for distance_m, row, name in sorted(pairs):
            if names[row] or row in unsure or name in names:
                continue
            rivals_m = [m for other, m in near[row].items() if other not in (*names, name)]
            rivals_m += [
                of[name]
                for other, of in near.items()
                if other != row and not names[other] and name in of
            ]
            if min(rivals_m, default=np.inf) < self._gate.ambiguity * distance_m:
                unsure.add(row)
            else:
                names[row] = name
        return unsure

    def _near(self, seen: SeenObject, path_m: float) -> Iterator[tuple[str, float]]:
        """Yield names and distances [m] of the objects that one may be."""
        for known in self._known.values():
            distance_m = _distance_m(known, seen)
            is_other = bool(seen.text) and known.has_text
            reach_m = self._gate.reach_m(path_m - known.path_m)
            if known.label == seen.label and not is_other and distance_m <= reach_m:
                yield known.name, distance_m


def _distance_m(a: SeenObject | KnownObject, b: SeenObject | KnownObject) -> float:
    return float(np.linalg.norm(a.p_frame - b.p_frame))
