"""Places that a LiDAR saw again, found without a guess: loop edges within missions and between them.

A mission whose place is unknown is anchored where enough of its keyframes agree on where it lies.
Source: Cramariuc et al., maplab 2.0, RA-L 2023, sections III-B (server) and III-D (anchoring, registration module).
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from mapstream.operators.lidar.constraints.keyframe_clouds import KeyframeClouds
from mapstream.operators.lidar.constraints.register import counted_verdicts, loop_edge
from mapstream.operators.lidar.places.anchoring import (
    AgreementConfig,
    anchor_by_edges,
    same_mission,
    without_lone_edges,
)
from mapstream.operators.lidar.places.place_matcher import (
    ACCEPTED,
    Judged,
    PlaceMatcher,
    PlaceMatchingConfig,
)
from mapstream.operators.lidar.registration import RegistrationResult
from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Edges
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError

SOURCE = "lidar_places"


class FindPlacesConfig(PlaceMatchingConfig, AgreementConfig):
    """Which keyframes are compared, and what becomes of those that are recognised."""

    within: bool = True
    """Compare a mission with its own past."""
    between: bool = True
    """Compare missions with those before them in the map."""
    neighbours: NonNegativeInt = 2
    """Keyframes on either side whose clouds are merged."""
    spacing_m: NonNegativeFloat = 2.0
    """Way between two places, and between two keyframes that are compared."""
    min_path_m: PositiveFloat = 15.0
    """So much way lies between the two ends of a loop within a mission."""
    sigma_rotation_rad: PositiveFloat = 0.005
    """Uncertainty that every loop has beyond what the registration claims."""
    sigma_translation_m: PositiveFloat = 0.03
    """The same of the position."""
    max_cloud_bytes: PositiveInt = 128_000_000
    """Memory for clouds; all of them are on disk."""

    def edge_covariance(self, result: RegistrationResult) -> FloatArray:
        """Return the covariance (6, 6) of the loop that a registration becomes."""
        floor = np.repeat([self.sigma_rotation_rad, self.sigma_translation_m], 3)
        covariance: FloatArray = result.covariance + np.diag(floor**2)
        return covariance


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarPlace:
    """A keyframe (b) and a place from before (a), and why they are or are not the same."""

    mission_a: str
    stamp_a_ns: int
    mission_b: str
    stamp_b_ns: int
    distance_m: float  # by the poses of the map
    num_inliers: int  # features of the looks that agree
    inlier_fraction: float
    rmse_m: float
    verdict: str  # "accepted", or the reason


@dataclass(frozen=True, slots=True, kw_only=True)
class FindPlacesReport:
    """What was compared, and what came of it."""

    num_compared: int  # keyframes
    num_unlike: int  # of these, those that look like no place
    num_blind: int  # of these, those that cannot be looked at: no ground
    num_within: int  # edges
    num_between: int  # edges
    num_alone: (
        int  # recognised places of other missions that too few others agree with; they give no edge
    )
    refused: dict[str, int]  # by the reason
    anchored: dict[str, str]  # mission -> "anchored", or why not
    places: list[LidarPlace]

    def lines(self) -> list[str]:
        """Return what to tell people."""
        blind = f", {self.num_blind} see no ground" if self.num_blind else ""
        alone = f"; {self.num_alone} stand alone and do not count" if self.num_alone else ""
        return [
            f"{self.num_compared} keyframes compared: {self.num_unlike} look like no place{blind}",
            f"{self.num_within} loops within missions, {self.num_between} between them{alone}",
            *(f"refused: {num}: {reason}" for reason, num in self.refused.items()),
            *(f"mission {mission[:8]}: {verdict}" for mission, verdict in self.anchored.items()),
        ]


def find_places(
    map_: Map,
    config: FindPlacesConfig | None = None,
    folder: Path | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> tuple[Map, FindPlacesReport]:
    """Return the map with its places recognised, and what became of each; edges of an earlier call go.

    Args:
        map_: The map; its poses are used for what is merged around a keyframe, never for where to look.
        config: See there.
        folder: Where its clouds are.
        on_progress: Takes the fraction that is done.

    Raises:
        MapError: If a cloud is not there or damaged.
        ConfigError: If there is no such recogniser or registration.
    """
    config = config or FindPlacesConfig()
    map_ = map_.select(edges=map_.edges.source != SOURCE)
    search = _Search(map_, KeyframeClouds(map_, folder, config.max_cloud_bytes), config)
    search.run(on_progress or (lambda _: None))
    if search.edges:
        map_ = append_edges(map_, concatenate(search.edges))
    map_, alone = without_lone_edges(map_, SOURCE, config)
    map_, anchored = anchor_by_edges(map_, SOURCE, config)
    edges = np.flatnonzero(map_.edges.source == SOURCE)
    is_within = same_mission(map_, edges)
    report = FindPlacesReport(
        num_compared=search.counts["compared"],
        num_unlike=search.counts["unlike"],
        num_blind=search.counts["blind"],
        num_within=int(is_within.sum()),
        num_between=int((~is_within).sum()),
        num_alone=alone,
        refused=counted_verdicts(place.verdict for place in search.places),
        anchored=anchored,
        places=search.places,
    )
    return map_, report


class _Search:
    """Compares keyframes with those before, mission after mission, and remembers what came of it."""

    def __init__(self, map_: Map, clouds: KeyframeClouds, config: FindPlacesConfig) -> None:
        self._map, self._clouds, self._config = map_, clouds, config
        self.edges: list[Edges] = []
        self.places: list[LidarPlace] = []
        self.counts: Counter[str] = Counter()

    def run(self, on_progress: Callable[[float], None]) -> None:
        """Compare all."""
        chosen = [self._spaced(mission) for mission in range(len(self._map.missions))]
        total, done = sum(len(vertices) for vertices, _ in chosen), 0
        matcher = PlaceMatcher(self._config, self._points)
        for vertices, way_m in chosen:
            own = PlaceMatcher(self._config, self._points) if not self._config.between else matcher
            waiting: deque[tuple[int, float]] = deque()
            for vertex, at_m in zip(vertices, way_m, strict=True):
                while waiting and at_m - waiting[0][1] >= self._config.min_path_m:
                    self._add(own, waiting.popleft()[0])
                self._compare(own, vertex)
                if self._config.within:
                    waiting.append((vertex, at_m))
                done += 1
                on_progress(done / total)
            for vertex in [v for v, _ in waiting] if self._config.within else vertices:
                self._add(own, vertex)

    def _spaced(self, mission: int) -> tuple[list[int], list[float]]:
        """Return keyframes of a mission with some way between, and how far along the way each lies."""
        rows = self._map.vertices_of(mission)
        rows = rows[np.isin(rows, self._clouds.vertices)]
        positions = self._map.vertices.T_mission_base[rows][:, :3, 3]
        steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        way_m = np.concatenate([[0.0], np.cumsum(steps_m)])[: len(rows)]
        vertices, at = list[int](), list[float]()
        for row, here_m in zip(rows.tolist(), way_m.tolist(), strict=True):
            if not at or here_m - at[-1] >= self._config.spacing_m:
                vertices.append(row)
                at.append(here_m)
        return vertices, at

    def _points(self, vertex: int) -> FloatArray:
        return self._clouds.around(vertex, self._config.neighbours, self._config.neighbours)

    def _add(self, matcher: PlaceMatcher, vertex: int) -> None:
        try:
            matcher.add(vertex)
        except EstimationError:
            self.counts["blind"] += 1

    def _compare(self, matcher: PlaceMatcher, vertex: int) -> None:
        self.counts["compared"] += 1
        try:
            judged = matcher.recognize(self._points(vertex))
        except EstimationError:
            return  # it is counted where it is added
        self.counts["unlike"] += not judged
        for each in judged:
            self.places.append(told_place(self._map, vertex, each))
            if each.verdict == ACCEPTED and each.result is not None:
                covariance = self._config.edge_covariance(each.result)
                key, T_a_b = each.proposal.key, each.result.T_target_source
                self.edges.append(loop_edge(key, vertex, T_a_b, covariance, SOURCE))


def told_place(map_: Map, vertex: int, judged: Judged) -> LidarPlace:
    """Return what became of a place that a vertex was compared with, by missions and stamps."""
    vertices, place, result = map_.vertices, judged.proposal.key, judged.result
    T_map = map_.T_map_base(np.array([place, vertex]))
    return LidarPlace(
        mission_a=map_.mission_id(int(vertices.mission[place])),
        stamp_a_ns=int(vertices.stamp_ns[place]),
        mission_b=map_.mission_id(int(vertices.mission[vertex])),
        stamp_b_ns=int(vertices.stamp_ns[vertex]),
        distance_m=float(np.linalg.norm(T_map[1, :3, 3] - T_map[0, :3, 3])),
        num_inliers=judged.proposal.num_inliers,
        inlier_fraction=float("nan") if result is None else result.inlier_fraction,
        rmse_m=float("nan") if result is None else result.rmse_m,
        verdict=judged.verdict,
    )
