"""Pairs of objects that may be the same thing: of one class, alike, never seen together, not too far apart.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section IV-D; thresholds of its semantic packages.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.objects.loops.placed_objects import PlacedObjects
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.columns import TextArray
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

OPEN = ""
"""The verdict on a pair that nothing speaks against so far."""
TOGETHER = "seen together in one image, so they are two things"
FAR = "too far apart by the poses of now"
UNLIKE = "descriptors differ too much"
OUTDONE = "others of the class are more alike"
TEXTS = "their texts differ"
TOO_MANY = "there are too many candidates, and others are nearer"


class DriftGate(OperatorConfig):
    """How far poses may be off where a place is seen again; it grows with the way between."""

    distance_m: PositiveFloat = 3.0
    distance_m_per_m: NonNegativeFloat = 0.03
    turn_rad: PositiveFloat = 0.2
    turn_rad_per_m: NonNegativeFloat = 0.02
    tilt_rad: PositiveFloat = 0.1
    """By which z may be off, which what senses gravity knows; the map frame's z is up."""
    tilt_rad_per_m: NonNegativeFloat = 0.002


class CandidatesConfig(OperatorConfig):
    """Which objects may be the same."""

    within: bool = True
    """Compare a mission with its own past."""
    between: bool = True
    """Compare missions with those before them."""
    min_gap_s: NonNegativeFloat = 10.0
    """Between when one was last seen and the other first, within a mission."""
    max_descriptor_distance: PositiveFloat = 1.2
    """Of unit vectors; sqrt(2) is what has nothing in common."""
    num_candidates: PositiveInt = 5
    """An object's most alike ones that are looked at, where there are descriptors."""
    max_candidates: PositiveInt = 500
    """That are looked at together, the nearest ones; work grows with their square."""
    gate: DriftGate = Field(default_factory=DriftGate)
    """Where both lie in the map frame is known; else objects anywhere may be the same."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Pairs (M,) of objects of one class, by their places in `PlacedObjects`."""

    a: IntArray  # seen before
    b: IntArray  # seen now
    distance_m: FloatArray  # by the poses of now
    max_turn_rad: (
        FloatArray  # by which the surroundings of one may be turned; infinite: nobody knows
    )
    max_tilt_rad: FloatArray  # the same of their z
    alikeness: FloatArray  # the distance of their descriptors; NaN: one has none
    verdict: TextArray = field(repr=False)  # OPEN, or why they are not the same

    def taken(self, rows: IntArray) -> Candidates:
        """Return some of these."""
        return Candidates(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @property
    def open(self) -> IntArray:
        """Those that nothing speaks against."""
        return np.flatnonzero(self.verdict == OPEN)


def candidates(
    objects: PlacedObjects,
    together: BoolArray,
    is_known: BoolArray,
    is_query: BoolArray,
    is_anchored: BoolArray,
    config: CandidatesConfig,
) -> Candidates:
    """Return the pairs of each queried object with those of its class that were there before.

    Args:
        objects: All objects (N,).
        together: Which were seen in one image (N, N).
        is_known: With which (N,) they are compared, if they were seen before or by other missions.
        is_query: Which (N,) are seen now.
        is_anchored: Which missions lie at a known place in the map frame.
        config: What they must have in common.
    """
    a, b = _of_one_class_before(objects, is_known, is_query, config)
    distance_m = np.linalg.norm(objects.positions[a] - objects.positions[b], axis=1)
    is_own = objects.mission[a] == objects.mission[b]
    way_m = np.where(is_own, np.abs(objects.first_way_m[b] - objects.last_way_m[a]), 0.0)
    gate = config.gate
    is_placed = is_own | (is_anchored[objects.mission[a]] & is_anchored[objects.mission[b]])
    reach_m = np.where(is_placed, gate.distance_m + gate.distance_m_per_m * way_m, np.inf)
    turn_rad = np.where(is_placed, gate.turn_rad + gate.turn_rad_per_m * way_m, np.inf)
    tilt_rad = np.where(is_placed, gate.tilt_rad + gate.tilt_rad_per_m * way_m, np.inf)
    alikeness = np.array(
        [_alikeness(objects, *pair) for pair in zip(a.tolist(), b.tolist(), strict=True)]
    )
    verdict = np.full(len(a), OPEN, object)
    verdict[alikeness > config.max_descriptor_distance] = UNLIKE
    verdict[distance_m > reach_m] = FAR
    verdict[together[a, b]] = TOGETHER
    differ = (
        (objects.text[a] != "") & (objects.text[b] != "") & (objects.text[a] != objects.text[b])
    )
    verdict[differ] = TEXTS
    found = Candidates(a, b, distance_m, turn_rad, tilt_rad, alikeness.reshape(len(a)), verdict)
    _keep_most_alike(found, config.num_candidates)
    nearest_first = found.open[np.argsort(distance_m[found.open], kind="stable")]
    verdict[nearest_first[config.max_candidates :]] = TOO_MANY
    return found


def _of_one_class_before(
    objects: PlacedObjects, is_known: BoolArray, is_query: BoolArray, config: CandidatesConfig
) -> tuple[IntArray, IntArray]:
    queries = np.flatnonzero(is_query)
    may_be = is_known[:, None] & (objects.label[:, None] == objects.label[queries])
    is_own = objects.mission[:, None] == objects.mission[queries]
    gap_ns = objects.first_ns[queries] - objects.last_ns[:, None]
    is_past = is_own & (gap_ns >= config.min_gap_s * 1e9) & config.within
    is_other = ~is_own & ~is_query[:, None] & config.between
    a, column = np.nonzero(may_be & (is_past | is_other))
    return a, queries[column]


def _alikeness(objects: PlacedObjects, a: int, b: int) -> float:
    """Return the distance of the descriptors of two objects that are most alike; NaN where one has none."""
    of_a, of_b = objects.descriptors[a], objects.descriptors[b]
    if not len(of_a) or not len(of_b) or of_a.shape[1] != of_b.shape[1]:
        return float("nan")
    return float(np.sqrt(max(2 - 2 * float((of_a @ of_b.T).max()), 0.0)))


def _keep_most_alike(found: Candidates, count: int) -> None:
    """Refuse all but the most alike of those that may be a queried object."""
    for b in np.unique(found.b[found.open]).tolist():
        rows = found.open[found.b[found.open] == b]
        rows = rows[np.isfinite(found.alikeness[rows])]
        found.verdict[rows[np.argsort(found.alikeness[rows], kind="stable")[count:]]] = OUTDONE
