"""Comparing the vertices of a map with those that were there before, in the order of time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

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
    """

    def __init__(
        self, config: SearchConfig, projections: Mapping[str, DescriptorProjection] | None = None
    ) -> None:
        self._config, self._projections = config, dict(projections or {})
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
        seed = seed_of(map_.vertices.id[vertex].tobytes())
        found = recognize(views.at(vertex), database, landmarks_map, self._config, seed=seed)
        return Compared(vertex, found)

    def _database(self, mission: int) -> PlaceDatabase:
        key = -1 if self._config.between else mission
        if key not in self._databases:
            self._databases[key] = PlaceDatabase(self._config.look, self._projections)
        return self._databases[key]


def search(map_: Map, config: SearchConfig) -> Iterator[Compared]:
    """Yield what comes of comparing the vertices of a map with the past, mission by mission."""
    landmarks_map = landmark_positions(map_)
    views = VertexViews(map_, config.kinds)
    searching = Search(config, projections_of(map_, "index"))
    for mission in range(len(map_.missions)):
        for vertex in map_.vertices_of(mission)[:: config.every].tolist():
            compared = searching.compare(map_, vertex, views, landmarks_map)
            if compared is not None:
                yield compared


def landmark_positions(map_: Map) -> FloatArray:
    """Return where all landmarks are in the map frame (L, 3) [m]."""
    positions: FloatArray = map_.T_map_landmark(np.arange(len(map_.landmarks)))[:, :3, 3]
    return positions
