"""Which keypoints of two images look the same: maplab's rules.

Bits are compared by the share of them that is equal, numbers by the cosine. The best candidate must be better than
the second best by Lowe's ratio, and matches are one to one: who loses its best to another tries again, and then
must be more alike, since there is no second best any more.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import Field, NonNegativeInt

from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

Descriptors = npt.NDArray[Any]


class MatchRules(OperatorConfig):
    """When two descriptors match."""

    min_similarity: float = Field(default=0.8, ge=0, le=1)
    """Share of equal bits, or cosine, of a match."""
    min_similarity_again: float = Field(default=0.85, ge=0, le=1)
    """The same, of a keypoint whose best candidate matched another one better."""
    max_ratio: float = Field(default=0.8, gt=0, le=1)
    """Difference to the best candidate, as a share of that to the second best (Lowe)."""
    num_rounds: NonNegativeInt = 3
    """So often such keypoints try again."""


def differences(before: Descriptors, now: Descriptors, pairs: IntArray) -> FloatArray:
    """Return how much descriptors differ, (K,): the share of bits, or the distance on the unit sphere.

    Args:
        before: (M, D) of bits (uint8) or of numbers (float32).
        now: (N, D) of the same.
        pairs: (K, 2) rows to compare.
    """
    if before.dtype == np.uint8:
        different = _words(before)[pairs[:, 0]] ^ _words(now)[pairs[:, 1]]
        num_bits = 8 * before.shape[1]
        shares: FloatArray = np.bitwise_count(different).sum(axis=1) / num_bits
        return shares
    cosines = np.einsum("kd,kd->k", _unit(before)[pairs[:, 0]], _unit(now)[pairs[:, 1]])
    return _apart(cosines.astype(np.float64))


def allowed(similarity: float, descriptors: Descriptors) -> float:
    """Return the difference of two descriptors that are so similar."""
    if descriptors.dtype == np.uint8:
        return 1 - similarity
    return float(_apart(np.array(similarity)))


def matched(
    before: Descriptors, now: Descriptors, rules: MatchRules, pairs: IntArray | None = None
) -> IntArray:
    """Return matches (K, 2): rows before and now, in the order of the former.

    Args:
        before: (M, D) of bits (uint8) or of numbers (float32).
        now: (N, D) of the same.
        rules: When they match.
        pairs: (C, 2) rows that may match; all with all by default.
    """
    if pairs is None:
        pairs = np.indices((len(before), len(now))).reshape(2, -1).T
    return one_to_one(pairs, differences(before, now, pairs), rules, before)


def one_to_one(
    pairs: IntArray, difference: FloatArray, rules: MatchRules, descriptors: Descriptors
) -> IntArray:
    """Return which of the pairs (C, 2) match, (K, 2), by their differences (C,)."""
    order = np.lexsort((pairs[:, 1], difference, pairs[:, 0]))
    pairs, difference = pairs[order], difference[order]
    limit = np.full(pairs[:, 0].max(initial=-1) + 1, allowed(rules.min_similarity, descriptors))
    is_open = _is_distinct(pairs[:, 0], difference, rules.max_ratio)
    winners = np.empty(0, dtype=np.int64)
    for _ in range(1 + rules.num_rounds):
        rows = np.flatnonzero(is_open)
        best = rows[np.unique(pairs[rows, 0], return_index=True)[1]]
        best = best[difference[best] <= limit[pairs[best, 0]]]
        best = best[np.argsort(difference[best], kind="stable")]
        winners = best[np.unique(pairs[best, 1], return_index=True)[1]]
        losers = np.setdiff1d(best, winners)
        if len(losers) == 0:
            break
        is_open[losers] = False
        limit[pairs[losers, 0]] = allowed(rules.min_similarity_again, descriptors)
    matches: IntArray = pairs[np.sort(winners)]
    return matches


def _is_distinct(queries: IntArray, difference: FloatArray, max_ratio: float) -> BoolArray:
    """Return which pairs (C,), sorted by query and difference, have a query whose best one stands out."""
    first = np.unique(queries, return_index=True)[1]
    has_second = np.append(queries[1:] == queries[:-1], False)[first]  # the last has none
    second = np.where(has_second, np.append(difference[1:], np.inf)[first], np.inf)
    stands_out = difference[first] < max_ratio * second
    num_pairs = np.diff(np.append(first, len(queries)))
    return np.repeat(stands_out, num_pairs)


def _words(bits: Descriptors) -> npt.NDArray[Any]:
    """Return descriptors in words of 64 bits where their length allows it: they are counted faster."""
    return np.ascontiguousarray(bits).view(np.uint64) if bits.shape[1] % 8 == 0 else bits


def _unit(descriptors: Descriptors) -> npt.NDArray[Any]:
    norms = np.linalg.norm(descriptors, axis=1, keepdims=True)
    unit: npt.NDArray[Any] = descriptors / np.where(norms > 0, norms, 1)
    return unit


def _apart(cosines: FloatArray) -> FloatArray:
    distances: FloatArray = np.sqrt(np.maximum(2 - 2 * cosines, 0))
    return distances
