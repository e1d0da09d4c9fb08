"""Which tracks are of one and the same thing: of one class, at one place, and never seen side by side.

Source of the rule that what is seen twice in an image is two things: Cramariuc et al., maplab 2.0, RA-L 2023,
section IV-D (unique visibility).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from mapstream.operators.landmarks.locating import FOUND
from mapstream.operators.objects.landmarks.placing import Place, Places, PlacingConfig, key_of
from mapstream.operators.objects.landmarks.sightings import Sightings, overlap
from mapstream.recordings.maps.columns import TextArray
from mapstream.streams.arrays import FloatArray, IntArray

_SIZES_ALIKE = 2.5  # a thing looks at most so much larger from elsewhere


class SameConfig(PlacingConfig):
    """When two tracks are of one thing."""

    max_apart_sigma: NonNegativeFloat = 3.0
    """Of the uncertainty of both places, so far may they be apart."""
    max_apart_sizes: NonNegativeFloat = 0.5
    """And in addition so much of how large they look: one sees the near side of things."""
    min_duplicate_overlap: float = Field(default=0.7, gt=0, le=1)
    """Two boxes in one image are of one thing if so much of the smaller one lies in the other."""
    max_gap_s: PositiveFloat | None = None
    """What a mission saw again only after so long stays another thing, which loop closure compares with the first:
    odometry drifted meanwhile."""


@dataclass(frozen=True, slots=True, eq=False)
class Thing:
    """Sightings of one thing, or of a part of its life."""

    place: Place
    label: str
    text: str
    missions: frozenset[int]  # those whose frames agree are one
    landmarks: tuple[int, ...]  # rows that it has in the map already

    @property
    def members(self) -> IntArray:
        return self.place.members

    @property
    def is_placed(self) -> bool:
        return self.place.outcome == FOUND


def most(texts: TextArray) -> str:
    """Return the text that most have; of several the first in the alphabet; "" if there is none."""
    values, counts = np.unique(texts[texts != ""].astype(str), return_counts=True)
    return str(values[counts.argmax()]) if len(values) else ""


class Matcher:
    """Finds which tracks are of one thing, and remembers which are not."""

    def __init__(self, sightings: Sightings, config: SameConfig) -> None:
        self._sightings, self._config = sightings, config
        self._places = Places(sightings, config)
        self._refused: set[tuple[bytes, bytes]] = set()

    def thing(self, members: IntArray, landmarks: tuple[int, ...] = ()) -> Thing:
        """Return the thing that some sightings show, with the class that most of them give it."""
        place = self._places.of(members)
        return Thing(
            place,
            most(self._sightings.labels[place.members]),
            most(self._sightings.texts[place.members]),
            frozenset(self._sightings.missions[members].tolist()),
            landmarks,
        )

    def made_one(self, things: Sequence[Thing]) -> tuple[list[Thing], list[Thing]]:
        """Return things, one for each that there is, and tracks that belong to none.

        The nearest pairs are joined first, and every join is judged with all that were made before it.
        """
        whole = [thing for thing in things if thing.is_placed]
        parts = [thing for thing in things if not thing.is_placed]
        num = len(things) + 1
        while len(whole) + len(parts) < num:
            num = len(whole) + len(parts)
            whole = self._joined(whole)
            whole, parts = self._with_parts(whole, parts)
        return whole, parts

    def _joined(self, things: list[Thing]) -> list[Thing]:
        """Return things after those that are near each other were made one, as long as there are any."""
        while True:
            new: dict[int, Thing] = {}
            gone: set[int] = set()
            for a, b in _near(things, self._config):
                if new.keys().isdisjoint((a, b)) and gone.isdisjoint((a, b)):
                    union = self._union(things[a], things[b])
                    if union is not None:
                        new[a] = union
                        gone.add(b)
            if not new:
                return things
            things = [new.get(n, thing) for n, thing in enumerate(things) if n not in gone]

    def _with_parts(
        self, things: Sequence[Thing], parts: Sequence[Thing]
    ) -> tuple[list[Thing], list[Thing]]:
        """Return things with the tracks that have no place but point at one, and tracks that do not."""
        things, left = list(things), []
        for part in parts:
            alike = [n for n, thing in enumerate(things) if thing.label == part.label]
            misses = {n: self._miss(things[n], part) for n in alike}
            best = min(misses, key=lambda n: misses[n], default=-1)
            is_near = best >= 0 and misses[best] <= self._config.max_error_sigma
            union = self._union(things[best], part) if is_near else None
            if union is None:
                left.append(part)
            else:
                things[best] = union
        return things, left

    def _union(self, a: Thing, b: Thing) -> Thing | None:
        """Return the thing that both are; None if they cannot be, or most detections of one do not agree."""
        key = key_of(a.members), key_of(b.members)
        if key in self._refused:
            return None
        if self._can_be_one(a, b):
            members = np.sort(np.concatenate([a.members, b.members]))
            landmarks = tuple(sorted({*a.landmarks, *b.landmarks}))
            union = self.thing(members, landmarks)
            shares = (np.isin(each.members, union.members).mean() for each in (a, b))
            if union.is_placed and min(shares) >= self._config.min_share:
                return union
        self._refused.add(key)
        return None

    def _can_be_one(self, a: Thing, b: Thing) -> bool:
        if not a.missions & b.missions or (a.text and b.text and a.text != b.text):
            return False
        if self._gap_s(a, b) > (self._config.max_gap_s or np.inf):
            return False
        least = self._config.min_duplicate_overlap
        return not seen_apart(self._sightings, a.members, b.members, least)

    def _gap_s(self, a: Thing, b: Thing) -> float:
        """Return how long neither of two things was seen, between them; not positive if there is no such time."""
        stamps_a, stamps_b = (self._sightings.stamps_ns[thing.members] for thing in (a, b))
        gap_ns = max(stamps_a.min(), stamps_b.min()) - min(stamps_a.max(), stamps_b.max())
        return float(gap_ns) / 1e9

    def _miss(self, thing: Thing, part: Thing) -> float:
        """Return by how much [sigma] rays pass a thing; infinite if it would look much larger or smaller."""
        views = self._sightings.views.taken(part.members)
        away = thing.place.position - views.T_map_sensor[:, :3, 3]
        distance_m = np.linalg.norm(away, axis=1)
        along = np.einsum("ni,ni->n", away, views.rays)
        off_m = np.linalg.norm(away - along[:, None] * views.rays, axis=1)
        sigma_m = np.hypot(views.ray_sigmas_rad * distance_m, _sigma_across(thing, views.rays))
        sides_m = self._sightings.sides_rad[part.members].clip(min=0) * distance_m[:, None]
        size_m, own_m = float(np.median(np.sqrt(sides_m.prod(axis=1)))), thing.place.size_m
        if not own_m / _SIZES_ALIKE <= size_m <= own_m * _SIZES_ALIKE:
            return np.inf
        return float(np.where(along > 0, off_m / sigma_m, np.inf).max())


def _near(things: Sequence[Thing], config: SameConfig) -> list[tuple[int, int]]:
    """Return pairs of things of one class that are near each other, the nearest first."""
    if len(things) < 2:
        return []
    positions = np.array([thing.place.position for thing in things])
    covariances = np.array([thing.place.covariance for thing in things])
    sizes_m = np.array([thing.place.size_m for thing in things])
    _, labels = np.unique([thing.label for thing in things], return_inverse=True)
    first, second = np.triu_indices(len(things), 1)
    alike = labels[first] == labels[second]
    first, second = first[alike], second[alike]
    apart = positions[first] - positions[second]
    distance_m = np.linalg.norm(apart, axis=1)
    gate_m = _sigma_along(apart, covariances[first] + covariances[second])
    gate_m = config.max_apart_sigma * gate_m
    gate_m += config.max_apart_sizes * (sizes_m[first] + sizes_m[second]) / 2
    order = np.lexsort((second, first, distance_m / gate_m))
    order = order[(distance_m <= gate_m)[order]]
    return list(zip(first[order].tolist(), second[order].tolist(), strict=True))


def _sigma_along(directions: FloatArray, covariances: FloatArray) -> FloatArray:
    length = np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    n = directions / length
    sigma: FloatArray = np.sqrt(np.einsum("ni,nij,nj->n", n, covariances, n))
    return sigma


def seen_apart(sightings: Sightings, a: IntArray, b: IntArray, min_overlap: float) -> bool:
    """Return whether some image shows two sets of sightings in boxes that do not overlap so much."""
    both = np.intersect1d(sightings.images[a], sightings.images[b])
    for image in both.tolist():
        boxes = (sightings.boxes_px[m[sightings.images[m] == image]] for m in (a, b))
        if (overlap(*boxes) < min_overlap).any():
            return True
    return False


def _sigma_across(thing: Thing, rays: FloatArray) -> FloatArray:
    """Return how unsure a place is across rays (N,) [m]."""
    total = np.trace(thing.place.covariance)
    along = np.einsum("ni,ij,nj->n", rays, thing.place.covariance, rays)
    sigma: FloatArray = np.sqrt(np.maximum(total - along, 0) / 2)
    return sigma
