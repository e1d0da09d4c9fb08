"""The objects that a robot knows, and which of them it sees again.

What is written on a thing, or its tag, is its identity. Without one it is the thing that its track was, or the
nearest of its class, within a gate that grows with the way: odometry drifts. Where two may be meant, none is.
Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section IV (object plugins).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

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

    @property
    def objects(self) -> list[KnownObject]:
        """Return all, the oldest first."""
        return list(self._known.values())

    def see(
        self, stamp_ns: int, objects: Sequence[SeenObject], T_frame_base: FloatArray, path_m: float
    ) -> list[tuple[KnownObject, ...]]:
        """Return which object each one is that is seen at one moment; none where two may be meant.

        Who had no name and now shows its text is both: the one of that text, and the one that it was so far.

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
            now = KnownObject(
                name=name,
                label=seen.label,
                has_text=bool(text) or (before is not None and before.has_text),
                is_pose=before.is_pose if before else seen.is_oriented,
                p_frame=seen.p_frame,
                seen_ns=stamp_ns,
                path_m=path_m,
                p_base=T_base_frame[:3, :3] @ seen.p_frame + T_base_frame[:3, 3],
            )
            found.append((now, *self._replaced(seen, now)))
        return found

    def move(self, T_frame_base_at: Callable[[int], FloatArray]) -> None:
        """Put each object where it was seen last from, by the robot's poses (4, 4) at stamps as they are known now."""
        for name, known in self._known.items():
            T = T_frame_base_at(known.seen_ns)
            self._known[name] = replace(known, p_frame=T[:3, :3] @ known.p_base + T[:3, 3])

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
            distance_m = float(np.linalg.norm(known.p_frame - seen.p_frame))
            is_other = bool(seen.text) and known.has_text
            reach_m = self._gate.reach_m(path_m - known.path_m)
            if known.label == seen.label and not is_other and distance_m <= reach_m:
                yield known.name, distance_m

    def _replaced(self, seen: SeenObject, now: KnownObject) -> list[KnownObject]:
        """Take an object in; return the one that its track was before it showed its text, and forget that."""
        self._known[now.name] = now
        if seen.track is None:
            return []
        before = self._known.get(self._of_track.get(seen.track, now.name))
        self._of_track[seen.track] = now.name
        if before is None or before.name == now.name or before.has_text:
            return []
        del self._known[before.name]
        return [before]
