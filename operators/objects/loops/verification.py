"""The motion that most pairs of objects agree on, if it is no accident and no other motion is nearly as good.

Triples of pairs whose distances agree propose motions, and each is judged by all pairs that it explains, one to one.
Too few are an accident where there are many ways to choose them: the expected number of such sets among unrelated
objects must be small (Desolneux, Moisan, Morel: From Gestalt Theory to Image Analysis, 2008, chapter 3). Rows of
things that are alike explain several motions, and then none is believed.
Source: Cramariuc et al., maplab 2.0, RA-L 2023, section IV-D (geometric verification).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.objects.loops.candidates import Candidates
from mapstream.operators.objects.loops.consistency import (
    Consistency,
    ToleranceConfig,
    consistency,
)
from mapstream.operators.objects.loops.horn import alignments
from mapstream.operators.objects.loops.placed_objects import PlacedObjects, weights
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.geometry import so3_log

_ROUNDS = 5  # of choosing pairs by a motion and a motion by pairs


class VerificationConfig(ToleranceConfig):
    """When pairs of objects are believed."""

    min_objects: PositiveInt = Field(default=3, ge=3)
    """That two clusters must have in common."""
    max_chance: PositiveFloat = 0.01
    """How many sets of pairs as large may be expected among unrelated objects."""
    max_rival_share: PositiveFloat = 0.7
    """Another motion that explains so many pairs, relative to the best, makes the place ambiguous."""
    max_hypotheses: PositiveInt = 2000
    """Of more triples so many are tried, at random."""
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """The pairs that agree on a motion, and how far they can be trusted."""

    pairs: IntArray  # places in the list of pairs
    explained: IntArray  # these, and those that fit as well but whose objects fit others better
    T_a_b: FloatArray  # (4, 4), both in the map frame: how far it is off
    chance: float  # how many such sets are expected among unrelated objects
    num_rival: int  # pairs that another motion explains
    rmse_m: float


class Pairs:
    """Pairs of objects that may be the same, and what they say of each other."""

    def __init__(
        self,
        objects: PlacedObjects,
        near: BoolArray,
        together: BoolArray,
        pairs: Candidates,
        config: VerificationConfig,
    ) -> None:
        self._objects, self._near, self._config = objects, near, config
        self._distance_m = np.linalg.norm(objects.positions[:, None] - objects.positions, axis=2)
        alike = objects.label[:, None] == objects.label
        # parts of one thing that was not recognised as one, or the same part
        self._may_be_one: BoolArray = near & alike & (self._distance_m <= config.max_error_m)
        self._may_be_one &= ~together | np.eye(len(objects), dtype=np.bool_)
        self._a, self._b = pairs.a, pairs.b
        self._max_turn_rad, self._max_tilt_rad = pairs.max_turn_rad, pairs.max_tilt_rad
        self._said = self._consistency(pairs.a, pairs.b, pairs.max_turn_rad)

    def _consistency(self, a: IntArray, b: IntArray, max_turn_rad: FloatArray) -> Consistency:
        return consistency(self._objects, a, b, self._near, max_turn_rad, self._config)

    def best(self) -> Agreement | None:
        """Return the motion that most pairs agree on; None if no three do."""
        triples = self._triples()
        if not len(triples):
            return None
        a, b = (self._objects.positions[rows[triples]] for rows in (self._a, self._b))
        motions = alignments(a, b)
        is_plausible = self._is_plausible(motions, triples)
        triples, motions = triples[is_plausible], motions[is_plausible]
        if not len(triples):
            return None
        fits = self._fits(motions, self._around(triples))
        counts = np.array([self._one_to_one_bound(np.flatnonzero(row)) for row in fits])
        order = np.argsort(-self._scores(motions, fits), kind="stable")
        first = triples[order[0]]
        T, pairs, explained = self._refined(motions[order[0]], self._around(first[None])[0])
        if len(pairs) < self._config.min_objects:
            return None
        off = self._off(T[None])[0, pairs]
        return Agreement(
            pairs=pairs,
            explained=explained,
            T_a_b=T,
            chance=self._chance(pairs),
            num_rival=self._rival(fits[order], counts[order], explained),
            rmse_m=float(np.sqrt((off**2).sum(axis=1).mean())),
        )

    def _triples(self) -> IntArray:
        """Return triples of pairs (T, 3) all of whose distances agree."""
        agree = self._said.agree
        first, second = np.nonzero(np.triu(agree, 1))
        third = agree[first] & agree[second] & (np.arange(len(agree)) > second[:, None])
        edge, last = np.nonzero(third)
        triples = np.stack([first[edge], second[edge], last], axis=1)
        most = self._config.max_hypotheses
        if len(triples) > most:
            rng = np.random.default_rng(self._config.seed)
            triples = triples[np.sort(rng.choice(len(triples), most, replace=False))]
        return triples

    def _is_plausible(self, motions: FloatArray, triples: IntArray) -> BoolArray:
        """Return which motions (T,) turn and tilt no more than poses may be off."""
        turn_rad: FloatArray = np.linalg.norm(so3_log(motions[:, :3, :3]), axis=1)
        tilt_rad = np.arccos(np.clip(motions[:, 2, 2], -1, 1))
        max_turn_rad = self._max_turn_rad[triples].min(axis=1)
        max_tilt_rad = self._max_tilt_rad[triples].min(axis=1)
        is_plausible: BoolArray = np.logical_and(turn_rad <= max_turn_rad, tilt_rad <= max_tilt_rad)
        return is_plausible

    def _around(self, triples: IntArray) -> BoolArray:
        """Return which pairs (T, M) were seen around the time of all of a triple, in both places."""
        a, b, near = self._a, self._b, self._near
        around_a = near[a[triples]][:, :, a].all(axis=1)
        around: BoolArray = np.asarray(around_a & near[b[triples]][:, :, b].all(axis=1))
        return around

    def _off(self, motions: FloatArray) -> FloatArray:
        """Return how far pairs are off after motions (H, M, 3) [m]."""
        p_a, p_b = self._objects.positions[self._a], self._objects.positions[self._b]
        moved = np.einsum("hij,mj->hmi", motions[:, :3, :3], p_b) + motions[:, None, :3, 3]
        off: FloatArray = p_a - moved
        return off

    def _in_sigmas(self, motions: FloatArray) -> FloatArray:
        """Return the distances (H, M) of pairs after motions, in units of their sigma in that direction."""
        off = self._off(motions)
        length = np.maximum(np.linalg.norm(off, axis=2), 1e-12)
        u_a = off / length[:, :, None]
        u_b = np.einsum("hji,hmj->hmi", motions[:, :3, :3], u_a)
        C = self._objects.covariances
        variance = np.einsum("hmi,mij,hmj->hm", u_a, C[self._a], u_a)
        variance += np.einsum("hmi,mij,hmj->hm", u_b, C[self._b], u_b)
        # what fits exactly is off in no direction
        in_sigmas: FloatArray = length / np.sqrt(np.maximum(variance, 1e-12))
        in_sigmas[length > self._config.max_error_m] = np.inf
        return in_sigmas

    def _fits(self, motions: FloatArray, around: BoolArray) -> BoolArray:
        fits: BoolArray = around & (self._in_sigmas(motions) <= self._config.num_sigmas)
        return fits

    def _scores(self, motions: FloatArray, fits: BoolArray) -> FloatArray:
        """Return what motions (H,) are worth: each object of b by how well its best partner fits (MSAC)."""
        worth = np.where(fits, self._config.num_sigmas**2 - self._in_sigmas(motions) ** 2, 0.0)
        scores = np.zeros((len(motions), len(self._objects)))
        for m, b in enumerate(self._b.tolist()):
            scores[:, b] = np.maximum(scores[:, b], worth[:, m])
        summed: FloatArray = scores.sum(axis=1)
        return summed

    def _one_to_one_bound(self, rows: IntArray) -> int:
        """Return how many of these pairs can be true at once at most."""
        return min(len(set(self._a[rows].tolist())), len(set(self._b[rows].tolist())))

    def _refined(self, T: FloatArray, around: BoolArray) -> tuple[FloatArray, IntArray, IntArray]:
        """Return a motion by all pairs that it explains one to one, these pairs, and all that fit."""
        pairs, explained = np.empty(0, np.int64), np.empty(0, np.int64)
        for _ in range(_ROUNDS):
            before = pairs
            in_sigmas = self._in_sigmas(T[None])[0]
            explained = np.flatnonzero(around & (in_sigmas <= self._config.num_sigmas))
            pairs = self._assigned(explained, in_sigmas[explained])
            if len(pairs) < self._config.min_objects or np.array_equal(pairs, before):
                break
            T = self._aligned(pairs)
        return T, pairs, explained

    def _aligned(self, pairs: IntArray) -> FloatArray:
        a, b = self._a[pairs], self._b[pairs]
        p = self._objects.positions
        aligned: FloatArray = alignments(p[a][None], p[b][None], weights(self._objects, a, b))[0]
        return aligned

    def _assigned(self, pairs: IntArray, in_sigmas: FloatArray) -> IntArray:
        """Return those of the pairs that are true together: each object once, and none where another is."""
        from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  # takes long to import

        rows_a, at_a = np.unique(self._a[pairs], return_inverse=True)
        rows_b, at_b = np.unique(self._b[pairs], return_inverse=True)
        never = 1e6
        cost = np.full((len(rows_a), len(rows_b)), never)
        cost[at_a, at_b] = in_sigmas**2 - self._config.num_sigmas**2  # more pairs beat a better fit
        number = np.full(cost.shape, -1)
        number[at_a, at_b] = np.arange(len(pairs))
        chosen = number[linear_sum_assignment(np.minimum(cost, 0.0))]
        chosen = chosen[chosen >= 0]
        kept: list[int] = []
        for n in chosen[np.argsort(in_sigmas[chosen], kind="stable")].tolist():
            if not any(self._is_again(pairs[n], other) for other in kept):
                kept.append(int(pairs[n]))
        return np.sort(np.array(kept, np.int64))

    def _is_again(self, pair: int, other: int) -> bool:
        """Whether the objects of two pairs are likely two parts of one, in either place."""
        variance = np.trace(self._objects.covariances, axis1=1, axis2=2) / 3
        for rows in (self._a, self._b):
            m, n = rows[pair], rows[other]
            reach_m = self._config.num_sigmas * np.sqrt(variance[m] + variance[n])
            if self._may_be_one[m, n] and self._distance_m[m, n] <= reach_m:
                return True
        return False

    def _chance(self, pairs: IntArray) -> float:
        """Return how many sets of so many pairs would agree if objects were anywhere."""
        # what pairs of objects say of each other whatever their class is: nearly all are unrelated
        around_a = np.flatnonzero(self._near[self._a[pairs]].all(axis=0))
        around_b = np.intersect1d(self._b, np.flatnonzero(self._near[self._b[pairs]].all(axis=0)))
        a, b = (grid.ravel() for grid in np.meshgrid(around_a, around_b))
        said = self._consistency(a, b, np.full(len(a), self._max_turn_rad[pairs].max()))
        num_meet = max(int(said.meet.sum()), 1)
        by_distance = said.distances_agree.sum() / num_meet
        by_direction = said.agree.sum() / num_meet
        # six numbers of the motion are free: the first pair fixes three, the second two, the third one
        num = len(pairs)
        counts = np.unique(self._b, return_counts=True)[1]
        ways = np.poly(-counts.astype(np.float64))[num]  # each object of b has one partner, or none
        return float(ways * by_direction ** (num - 1) * by_distance ** (2 * num - 5))

    def _rival(self, fits: BoolArray, counts: IntArray, explained: IntArray) -> int:
        """Return how many pairs another motion explains, at least half of them pairs that the best does not."""
        may_be_one = self._may_be_one
        again = may_be_one[np.ix_(self._a, self._a[explained])]
        again &= may_be_one[np.ix_(self._b, self._b[explained])]
        is_new = ~again.any(axis=1)
        least = max(self._config.max_rival_share * self._one_to_one_bound(explained), 1.0)
        for row, count in zip(fits, counts.tolist(), strict=True):
            if count >= least and 2 * self._one_to_one_bound(np.flatnonzero(row & is_new)) >= count:
                return int(count)
        return 0
