"""Places of a LiDAR recognised without a guess while maps grow, of this mission and of others."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from mapstream.operators.lidar.constraints.keyframe_clouds import KeyframeClouds
from mapstream.operators.lidar.places.find_places import (
    SOURCE,
    FindPlacesConfig,
    LidarPlace,
    told_place,
)
from mapstream.operators.lidar.places.place_matcher import ACCEPTED, Judged, PlaceMatcher
from mapstream.operators.maps.passing_clouds import PassingClouds
from mapstream.operators.operator import Operator, Placement, offload, warn
from mapstream.operators.places.agreement import agreement
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError
from mapstream.streams.messages.estimates import LoopCandidate, LoopReport, RelativePose, Submap


class LidarPlacesConfig(FindPlacesConfig):
    """Options of `lidar_places`."""


@dataclass(frozen=True)
class Inputs:
    """Submaps whose keyframes have clouds, of one mission or of several."""

    submaps: Receiver[Submap]


@dataclass(frozen=True)
class Outputs:
    """One report for each submap, whether it closes a loop or not."""

    loops: Sender[LoopReport]


@dataclass(frozen=True, slots=True, eq=False)
class _Claim:
    """A loop between two missions that waits for others that agree."""

    edge: RelativePose
    T_a_b: FloatArray  # (4, 4) where b's mission lies in a's
    position: FloatArray  # (3,) of the keyframe in b's mission


class LidarPlaces(Operator[Inputs, Outputs]):
    """Recognise places that a LiDAR saw before by their looks, and register the clouds around them.

    No guess is needed: neither drift nor an unknown start keeps a loop from closing. Loops between missions wait
    until `min_agreeing` of them agree on where the missions lie. Nothing is asked of the optimizer.
    """

    placement: ClassVar[Placement] = "process"  # small_gicp holds the GIL
    spans_epochs: ClassVar[bool] = True

    def __init__(self, config: LidarPlacesConfig) -> None:
        self._config = config
        self._map = Map.empty()
        self._clouds: KeyframeClouds | None = None
        self._past: dict[int, PlaceMatcher] = {}  # by mission: what it saw a while ago
        self._whole: dict[int, PlaceMatcher] = {}  # by mission: all that it saw
        self._waiting: dict[int, deque[tuple[int, float]]] = {}  # by mission: vertex, way [m]
        self._way: dict[int, tuple[float, FloatArray]] = {}  # by mission: way [m], where
        self._looked_m: dict[int, float] = {}  # by mission: where on the way was looked last
        self._claims: dict[tuple[str, str], list[_Claim]] = {}  # by missions
        self._sent: dict[tuple[str, str], set[int]] = {}  # by missions: which of the claims

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        with PassingClouds() as clouds:
            async for submap in inputs.submaps:
                await outputs.loops.send(await offload(self.search, submap, clouds))

    def search(self, submap: Submap, clouds: PassingClouds) -> LoopReport:
        """Look for places from the new keyframes of one submap."""
        first = len(self._map.vertices)
        clouds.keep(submap)
        self._map = append_submap(self._map, replace(submap, constraints=()))
        with_clouds = clouds.put_into(self._map)
        self._clouds = KeyframeClouds(with_clouds, clouds.folder, self._config.max_cloud_bytes)
        there = set(self._clouds.vertices.tolist())
        new = np.arange(first, len(self._map.vertices))
        new = new[np.argsort(self._map.vertices.stamp_ns[new], kind="stable")]
        edges: list[RelativePose] = []
        places: list[LidarPlace] = []
        for vertex in new.tolist():
            if self._is_due(vertex) and vertex in there:
                for judged in self._compare(vertex):
                    places.append(told_place(self._map, vertex, judged))
                    edges += self._believed(vertex, judged)
        return LoopReport(
            stamp_ns=submap.stamp_ns,
            edges=tuple(edges),
            candidates=tuple(_candidate(place) for place in places),
        )

    def _points(self, vertex: int) -> FloatArray:
        if self._clouds is None:
            raise EstimationError("no submap came yet")
        return self._clouds.around(vertex, self._config.neighbours, self._config.neighbours)

    def _is_due(self, vertex: int) -> bool:
        """Note how far the mission came, and return whether there is enough way since the last look."""
        mission = int(self._map.vertices.mission[vertex])
        here = self._map.vertices.T_mission_base[vertex][:3, 3]
        way_m, before = self._way.get(mission, (0.0, here))
        way_m += float(np.linalg.norm(here - before))
        self._way[mission] = way_m, here
        if way_m - self._looked_m.get(mission, -np.inf) < self._config.spacing_m:
            return False
        self._looked_m[mission] = way_m
        return True

    def _compare(self, vertex: int) -> list[Judged]:
        """Return what became of a keyframe's likeliest places, and remember it for later ones."""
        mission = int(self._map.vertices.mission[vertex])
        past = self._past.setdefault(mission, PlaceMatcher(self._config, self._points))
        whole = self._whole.setdefault(mission, PlaceMatcher(self._config, self._points))
        waiting = self._waiting.setdefault(mission, deque())
        way_m, points = self._way[mission][0], self._points(vertex)
        judged: list[Judged] = []
        try:
            if self._config.within:
                while waiting and way_m - waiting[0][1] >= self._config.min_path_m:
                    past.add(waiting.popleft()[0])
                judged += past.recognize(points)
            if self._config.between:
                for other in sorted(self._whole.keys() - {mission}):
                    judged += self._whole[other].recognize(points)
                whole.add(vertex)
        except EstimationError as error:
            warn(f"a keyframe cannot be looked at from above: {error}")
            return []
        waiting.append((vertex, way_m))
        return judged

    def _believed(self, vertex: int, judged: Judged) -> list[RelativePose]:
        """Return the loops that are believed now: this one, or all that agree with it between two missions."""
        if judged.verdict != ACCEPTED or judged.result is None:
            return []
        vertices, place = self._map.vertices, judged.proposal.key
        a, b = (self._map.mission_id(int(vertices.mission[row])) for row in (place, vertex))
        edge = RelativePose(
            kind="loop",
            mission_a=a,
            stamp_a_ns=int(vertices.stamp_ns[place]),
            mission_b=b,
            stamp_b_ns=int(vertices.stamp_ns[vertex]),
            T_a_b=judged.result.T_target_source,
            covariance=self._config.edge_covariance(judged.result),
            source=SOURCE,
            is_switchable=True,
        )
        if a == b:
            return [edge]
        T_b = vertices.T_mission_base_of(vertex)
        T_a_b = vertices.T_mission_base_of(place) @ edge.T_a_b @ T_b.inverse()
        return self._agreed(_Claim(edge, T_a_b.matrix, T_b.t))

    def _agreed(self, claim: _Claim) -> list[RelativePose]:
        """Return the loops that this one brings to agree, which were not sent yet."""
        missions = claim.edge.mission_a, claim.edge.mission_b
        claims = self._claims.setdefault(missions, [])
        claims.append(claim)
        agree = agreement(
            np.array([each.T_a_b for each in claims]),
            self._config.agree_rad,
            self._config.agree_m,
            np.array([each.position for each in claims]),
        )
        believed = np.flatnonzero(agree.sum(axis=1) >= self._config.min_agreeing).tolist()
        sent = self._sent.setdefault(missions, set())
        news = [row for row in believed if row not in sent]
        sent.update(news)
        return [claims[row].edge for row in news]


def _candidate(place: LidarPlace) -> LoopCandidate:
    return LoopCandidate(
        stamp_a_ns=place.stamp_a_ns,
        stamp_b_ns=place.stamp_b_ns,
        distance_m=place.distance_m,
        verdict=place.verdict,
        inlier_fraction=place.inlier_fraction,
        rmse_m=place.rmse_m,
        num_inliers=place.num_inliers,
    )
