"""Comparing the vertices of a map with those that were there before, in the order of time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from pydantic import NonNegativeFloat, PositiveInt

from mapstream.operators.places.database import PlaceDatabase
from mapstream.operators.places.recognition import (
    Recognition,
    RecognitionConfig,
    recognize,
    seed_of,
)
from mapstream.operators.places.views import VertexViews
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.projections import DescriptorProjection, projections_of
from mapstream.streams.arrays import FloatArray

Propose = Callable[[int, Collection[int]], Sequence[int]]
"""Returns which of some vertices are worth a look from a vertex."""


class SearchConfig(RecognitionConfig):
    """Which vertices are compared with which."""

    within: bool = True
    """Compare a mission with its own past."""
    between: bool = True
    """Compare missions with those before them in the map."""
    min_gap_s: NonNegativeFloat = 10.0
    """Between the two ends of a loop within a mission."""
    every: PositiveInt = 1
    """One vertex in so many is compared."""


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """What came of comparing one vertex."""

    vertex: int
    recognition: Recognition


class Search:
    """Compares vertices with those that came before; missions come one after another, or take turns.

    A vertex is put among what its own mission is compared with only when the gap is over, so that the nearest
    descriptors are never those of the moment before.

    Args:
        config: Which are compared.
        projections: By kind, of the indices.
        propose: Where to look, too; where matches alone say without.
        has_votes: Matches vote for places, and proposals come in where they recognise none; else proposals alone.
    """

    def __init__(
        self,
        config: SearchConfig,
        projections: Mapping[str, DescriptorProjection] | None = None,
        propose: Propose | None = None,
        *,
        has_votes: bool = True,
    ) -> None:
        self._config, self._projections = config, dict(projections or {})
        self._propose, self._has_votes = propose, has_votes
        self._databases: dict[int, PlaceDatabase] = {}  # by mission, or one of all
        self._waiting: dict[int, deque[int]] = {}  # by mission: vertices that are not put there yet

    def compare(
        self, map_: Map, vertex: int, views: VertexViews, landmarks_map: FloatArray
    ) -> Compared | None:
        """Compare the next vertex of a mission; None as long as there is nothing to compare it with."""
        mission = int(map_.vertices.mission[vertex])
        database = self._database(mission)
        until_ns = map_.vertices.stamp_ns[vertex] - round(self._config.min_gap_s * 1e9)
        for other, waiting in self._waiting.items():
            is_own = other == mission
            while waiting and (self._config.within if is_own else self._config.between):
                if is_own and map_.vertices.stamp_ns[waiting[0]] > until_ns:
                    break
                put = waiting.popleft()
                database.add(map_, put, views.at(put))
        self._waiting.setdefault(mission, deque()).append(vertex)
        if not len(database):
            return None
        look = partial(
            recognize,
            views.at(vertex),
            database,
            landmarks_map,
            self._config,
            seed=seed_of(map_.vertices.id[vertex].tobytes()),
        )
        if self._propose is None:
            return Compared(vertex, look())
        voted = look() if self._has_votes else None
        if voted is not None and voted.found is not None:
            return Compared(vertex, voted)
        proposed = look(vertices=self._propose(vertex, database.num_descriptors_of))
        return Compared(vertex, proposed if voted is None else _both(voted, proposed))

    def _database(self, mission: int) -> PlaceDatabase:
        key = -1 if self._config.between else mission
        if key not in self._databases:
            self._databases[key] = PlaceDatabase(self._config.look, self._projections)
        return self._databases[key]


def _both(a: Recognition, b: Recognition) -> Recognition:
    return Recognition(
        num_matches=a.num_matches + b.num_matches,
        candidates=(*a.candidates, *b.candidates),
        found=b.found,
    )


def search(
    map_: Map, config: SearchConfig, propose: Propose | None = None, *, has_votes: bool = True
) -> Iterator[Compared]:
    """Yield what comes of comparing the vertices of a map with the past, mission by mission; see `Search`."""
    landmarks_map = landmark_positions(map_)
    views = VertexViews(map_, config.kinds)
    searching = Search(config, projections_of(map_, "index"), propose, has_votes=has_votes)
    for mission in range(len(map_.missions)):
        for vertex in map_.vertices_of(mission)[:: config.every].tolist():
            compared = searching.compare(map_, vertex, views, landmarks_map)
            if compared is not None:
                yield compared


def landmark_positions(map_: Map) -> FloatArray:
    """Return where all landmarks are in the map frame (L, 3) [m]."""
    positions: FloatArray = map_.T_map_landmark(np.arange(len(map_.landmarks)))[:, :3, 3]
    return positions
