"""Places where objects are seen again: from what is seen now, to edges between clusters that are the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from mapstream.operators.objects.loops.candidates import (
    Candidates,
    CandidatesConfig,
    candidates,
)
from mapstream.operators.objects.loops.consistency import covisible
from mapstream.operators.objects.loops.edges import EdgeConfig, cluster_vertex, semantic_edge
from mapstream.operators.objects.loops.placed_objects import PlacedObjects, placed_objects
from mapstream.operators.objects.loops.seen_together import seen_together
from mapstream.operators.objects.loops.verification import Agreement, Pairs, VerificationConfig
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Edges
from mapstream.streams.arrays import BoolArray, IntArray
from mapstream.streams.errors import EstimationError

ACCEPTED = "accepted"
UNSURE = "where it is is not sure enough"
ALONE = "no three objects around it agree on a motion"
OTHERWISE = "does not fit what the objects around it agree on"
TAKEN = "its object fits another one better"


class SearchConfig(CandidatesConfig):
    """How objects are compared, and what becomes of those that are the same."""

    max_object_sigma_m: PositiveFloat = 0.12
    """Objects whose places are less sure, along any axis, are left out."""
    covisible_s: NonNegativeFloat = 5.0
    """Objects seen within this time are of one place."""
    verification: VerificationConfig = Field(default_factory=VerificationConfig)
    edge: EdgeConfig = Field(default_factory=EdgeConfig)


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """A cluster of objects that is one that was seen before."""

    pairs: IntArray  # (N,) places in the list of candidates
    agreement: Agreement
    edge: Edges  # one row


@dataclass(frozen=True, slots=True, eq=False)
class Searched:
    """What came of comparing what was seen from some vertices."""

    objects: PlacedObjects
    candidates: Candidates  # each with its verdict
    loops: tuple[Loop, ...]


class ObjectSearch:
    """Compares the objects of one map.

    Args:
        map_: With its landmarks of kind `object`.
        config: How they are compared.
    """

    def __init__(self, map_: Map, config: SearchConfig) -> None:
        self._map, self._config = map_, config
        self._objects = objects = placed_objects(map_, config.verification.sigma_m)
        self._together = seen_together(map_, objects.landmark)
        self._near = covisible(objects, config.covisible_s)
        sigmas_m = np.sqrt(np.linalg.eigvalsh(objects.covariances).max(axis=1, initial=0))
        self._is_sure: BoolArray = np.asarray(sigmas_m <= config.max_object_sigma_m)

    def search(self, vertices: IntArray, num_missions: int | None = None) -> Searched:
        """Compare the objects seen from some vertices of a mission with those seen before.

        Args:
            vertices: Rows.
            num_missions: Other missions than the first so many are left out; without, none is.
        """
        objects = self._objects
        is_query = np.array(
            [bool(np.isin(seen, vertices).any()) for seen in objects.vertices], bool
        )
        is_anchored = self._map.missions.is_base_frame_known
        is_known = objects.mission < (len(is_anchored) if num_missions is None else num_missions)
        found = candidates(objects, self._together, is_known, is_query, is_anchored, self._config)
        found.verdict[~(self._is_sure[found.a] & self._is_sure[found.b])] = UNSURE
        loops: list[Loop] = []
        left = found.open
        config = self._config.verification
        while len(left) >= config.min_objects:
            pairs = Pairs(objects, self._near, self._together, found.taken(left), config)
            agreement = pairs.best()
            if agreement is None:
                break
            chosen, explained = left[agreement.pairs], left[agreement.explained]
            is_around = self._near[np.ix_(found.a[left], found.a[chosen])].all(axis=1)
            found.verdict[left[is_around]] = OTHERWISE
            found.verdict[explained] = TAKEN
            found.verdict[chosen] = self._refusal(agreement)
            left = left[~is_around]
            if not self._refusal(agreement):
                found.verdict[chosen] = self._close(found, chosen, agreement, vertices, loops)
        found.verdict[left] = ALONE
        return Searched(objects, found, tuple(loops))

    def _refusal(self, agreement: Agreement) -> str:
        config = self._config.verification
        num = len(agreement.pairs)
        if agreement.num_rival:
            return f"ambiguous: {num} objects agree, and {agreement.num_rival} on another motion"
        if agreement.chance > config.max_chance:
            return f"{num} objects agree, as unrelated ones do: {agreement.chance:.2g} such sets expected"
        return ""

    def _close(
        self,
        found: Candidates,
        chosen: IntArray,
        agreement: Agreement,
        vertices: IntArray,
        loops: list[Loop],
    ) -> str:
        """Add the loop that some candidates close; return the verdict on them."""
        pairs = np.stack([found.a[chosen], found.b[chosen]])
        everywhere = np.arange(len(self._map.vertices))
        config = self._config.edge
        ends = (
            cluster_vertex(self._map, self._objects, pairs[0], everywhere, config),
            cluster_vertex(self._map, self._objects, pairs[1], vertices, config),
        )
        try:
            edge = semantic_edge(self._map, self._objects, ends, pairs, config)
        except EstimationError as error:
            return str(error)
        loops.append(Loop(chosen, agreement, edge))
        return ACCEPTED
