"""Visual loop closure while a map grows (Cramariuc et al., maplab 2.0, RA-L 2023, section III-C)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydantic import Field

from mapstream.operators.landmarks.create import create_landmarks
from mapstream.operators.landmarks.locating import LocateConfig
from mapstream.operators.operator import Operator, Placement, offload
from mapstream.operators.places.loops import (
    ComparedPlace,
    LoopEdgeConfig,
    compared_places,
    loop_edge,
)
from mapstream.operators.places.searching import Search, SearchConfig, landmark_positions
from mapstream.operators.places.views import VertexViews
from mapstream.operators.submaps.corrected_map import CorrectedMap
from mapstream.recordings.maps.model import Map
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.estimates import (
    LoopCandidate,
    LoopReport,
    MapCorrection,
    RelativePose,
    Submap,
)


class VisualLoopsConfig(SearchConfig):
    """Options of `visual_loops`."""

    edge: LoopEdgeConfig = Field(default_factory=LoopEdgeConfig)
    landmarks: LocateConfig = Field(default_factory=LocateConfig)
    """When tracks make landmarks, which frames are compared with."""


@dataclass(frozen=True)
class Inputs:
    """Submaps whose keyframes have features, and after each of them the optimizer's correction."""

    submaps: Receiver[Submap]
    corrections: Receiver[MapCorrection] | None = None


@dataclass(frozen=True)
class Outputs:
    """One report for each submap, whether it closes a loop or not."""

    loops: Sender[LoopReport]


class VisualLoops(Operator[Inputs, Outputs]):
    """Recognise places that cameras saw before, of this mission and of others.

    Landmarks are made of the tracks of each submap. Keyframes are compared with those older than a gap: matches
    vote for places, and a pose must explain what all cameras see. It becomes a loop edge that the optimizer may
    switch off; every refused place is in the report, with the reason. Poses are those that the optimizer had
    after the submap before, never newer ones, so a replay finds the same loops.
    """

    placement: ClassVar[Placement] = "thread"
    spans_epochs: ClassVar[bool] = True

    def __init__(self, config: VisualLoopsConfig) -> None:
        self._config = config
        self._corrected = CorrectedMap()
        self._search = Search(config)

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for submap in inputs.submaps:
            await self._corrected.follow(inputs.corrections, submap)
            await outputs.loops.send(await offload(self.search, submap))

    def search(self, submap: Submap) -> LoopReport:
        """Look for loops from the new keyframes of one submap."""
        new = self._corrected.append(submap)
        map_, _ = create_landmarks(self._corrected.map, self._config.landmarks)
        self._corrected.map = map_ = _with_open_tracks(map_)
        views, landmarks_map = VertexViews(map_, self._config.kinds), landmark_positions(map_)
        edges: list[RelativePose] = []
        places: list[ComparedPlace] = []
        for vertex in new[:: self._config.every].tolist():
            compared = self._search.compare(map_, vertex, views, landmarks_map)
            if compared is None:
                continue
            places += compared_places(map_, compared)
            if compared.recognition.found is not None:
                edge = loop_edge(map_, vertex, compared.recognition.found, self._config.edge)
                edges.append(self._corrected.loop(edge))
        return LoopReport(
            stamp_ns=submap.stamp_ns,
            edges=tuple(edges),
            candidates=tuple(_candidate(place) for place in places),
        )


def _with_open_tracks(map_: Map) -> Map:
    """Return the map without the tracks that ended and made no landmark, so that nobody tries them again."""
    seen = map_.observations
    newest = [map_.vertices_of(mission)[-1] for mission in range(len(map_.missions))]
    is_open = (seen.landmark >= 0) | np.isin(seen.vertex, newest)
    track = np.where(is_open, seen.track, -1)
    return replace(map_, observations=replace(seen, track=track))


def _candidate(place: ComparedPlace) -> LoopCandidate:
    return LoopCandidate(
        stamp_a_ns=place.stamp_a_ns,
        stamp_b_ns=place.stamp_b_ns,
        distance_m=place.distance_m,
        verdict=place.verdict,
        inlier_fraction=place.num_inliers / max(place.num_matches, 1),
        num_matches=place.num_matches,
        num_inliers=place.num_inliers,
        score=place.score,
    )
