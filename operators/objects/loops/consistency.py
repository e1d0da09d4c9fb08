"""Which pairs of objects can be the same at once: what is a metre apart in one place is so in the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from mapstream.operators.objects.loops.placed_objects import PlacedObjects
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray


class ToleranceConfig(OperatorConfig):
    """How exact the places of objects are."""

    sigma_m: PositiveFloat = 0.03
    """Uncertainty that every object's place has beyond its covariance: from elsewhere its box has another middle."""
    drift_m_per_m: NonNegativeFloat = 0.03
    """Distances between objects are off by so much, since the robot moves while it sees them."""
    num_sigmas: PositiveFloat = 3.0
    """What lies further apart does not agree."""
    max_error_m: PositiveFloat = 0.5
    """What lies further apart does not agree, however unsure it is."""


@dataclass(frozen=True, slots=True, eq=False)
class Consistency:
    """What pairs (M,) of objects say of each other, each matrix (M, M)."""

    meet: BoolArray  # four different objects; those of either place were seen around the same time
    distances_agree: BoolArray  # and they are as far apart in one place as in the other
    agree: BoolArray  # and in about the same direction


def covisible(objects: PlacedObjects, within_s: float) -> BoolArray:
    """Return which objects were seen with which, within a time (N, N)."""
    between_ns = np.maximum(objects.first_ns[:, None], objects.first_ns) - np.minimum(
        objects.last_ns[:, None], objects.last_ns
    )
    is_own = objects.mission[:, None] == objects.mission
    near: BoolArray = is_own & (between_ns <= within_s * 1e9)
    return near


def consistency(  # two columns of pairs, and what is known of objects
    objects: PlacedObjects,
    a: IntArray,
    b: IntArray,
    near: BoolArray,
    max_turn_rad: FloatArray,
    config: ToleranceConfig,
) -> Consistency:
    """Return which pairs (a, b) of objects can be true at once."""
    meet = near[np.ix_(a, a)] & near[np.ix_(b, b)]
    meet &= (a[:, None] != a) & (b[:, None] != b)
    v_a, length_a, variance_a = _between(objects, a)
    v_b, length_b, variance_b = _between(objects, b)
    drift_m = config.drift_m_per_m * np.maximum(length_a, length_b)
    allowed_m = config.num_sigmas * np.sqrt(variance_a + variance_b + drift_m**2)
    off_m = np.abs(length_a - length_b)
    # nearer than that, two are as good as one, and say nothing
    is_apart = np.minimum(length_a, length_b) > allowed_m
    distances_agree = meet & is_apart & (off_m <= np.minimum(allowed_m, config.max_error_m))
    cosine = (v_a * v_b).sum(axis=2) / np.maximum(length_a * length_b, 1e-12)
    blur_rad = np.arctan2(allowed_m, np.maximum(length_a, 1e-12))
    turn_rad = np.minimum(max_turn_rad[:, None], max_turn_rad)
    is_turned_little = np.arccos(np.clip(cosine, -1, 1)) <= turn_rad + blur_rad
    return Consistency(meet, distances_agree, distances_agree & is_turned_little)


def _between(objects: PlacedObjects, rows: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the vectors (M, M, 3) between objects, their lengths, and the variances of these."""
    p, C = objects.positions[rows], objects.covariances[rows]
    v = p[:, None] - p
    length = np.linalg.norm(v, axis=2)
    u = v / np.maximum(length, 1e-12)[:, :, None]
    variance = np.einsum("mni,mij,mnj->mn", u, C, u) + np.einsum("mni,nij,mnj->mn", u, C, u)
    return v, length, variance
