"""Comparing the vertices of a map with those that were there before, in the order of time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
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
from mapstream.streams.arrays import FloatArray

Projections = Mapping[str, npt.NDArray[np.float32]]
"""By kind of feature: matrices that project its bits to a few numbers."""


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
    """Compares vertices with those that were put before, but for the newest of the same mission.

    A vertex is put among what is compared with only when the gap is over, so that the nearest descriptors are
    never those of the moment before.
    """

    def __init__(self, config: SearchConfig, projections: Projections | None = None) -> None:
        self._config, self._projections = config, dict(projections or {})
        self._database = PlaceDatabase(config.look, self._projections)
        self._waiting: list[int] = []  # vertices of the mission of now, in the order of time

    def begin_mission(self) -> None:
        """Forget what may not be compared with the next mission."""
        if not self._config.between:
            self._database = PlaceDatabase(self._config.look, self._projections)

    def compare(
        self, map_: Map, vertex: int, views: VertexViews, landmarks_map: FloatArray
    ) -> Compared | None:
        """Compare the next vertex of a mission; None as long as there is nothing to compare it with."""
        stamps_ns = map_.vertices.stamp_ns
        until_ns = stamps_ns[vertex] - round(self._config.min_gap_s * 1e9)
        while self._config.within and self._waiting and stamps_ns[self._waiting[0]] <= until_ns:
            self._put(map_, self._waiting.pop(0), views)
        self._waiting.append(vertex)
        if not len(self._database):
            return None
        seed = seed_of(map_.vertices.id[vertex].tobytes())
        found = recognize(views.at(vertex), self._database, landmarks_map, self._config, seed=seed)
        return Compared(vertex, found)

    def end_mission(self, map_: Map, views: VertexViews) -> None:
        """Put all of the mission among what the next one is compared with."""
        for vertex in self._waiting:
            self._put(map_, vertex, views)
        self._waiting.clear()

    def _put(self, map_: Map, vertex: int, views: VertexViews) -> None:
        self._database.add(map_, vertex, views.at(vertex))


def search(
    map_: Map, config: SearchConfig, projections: Projections | None = None
) -> Iterator[Compared]:
    """Yield what comes of comparing the vertices of a map with the past, mission by mission."""
    landmarks_map = landmark_positions(map_)
    views = VertexViews(map_, config.kinds)
    searching = Search(config, projections)
    for mission in range(len(map_.missions)):
        searching.begin_mission()
        for vertex in map_.vertices_of(mission)[:: config.every].tolist():
            compared = searching.compare(map_, vertex, views, landmarks_map)
            if compared is not None:
                yield compared
        searching.end_mission(map_, views)


def landmark_positions(map_: Map) -> FloatArray:
    """Return where all landmarks are in the map frame (L, 3) [m]."""
    positions: FloatArray = map_.T_map_landmark(np.arange(len(map_.landmarks)))[:, :3, 3]
    return positions
