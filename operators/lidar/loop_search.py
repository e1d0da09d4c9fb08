"""Looking for places that were seen before, with any matcher of clouds.

Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section IV-C1.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from mapstream.operators.lidar.loop_matcher import Gate
from mapstream.operators.lidar.registration import Points, RegistrationResult
from mapstream.operators.lidar.surroundings import Surroundings
from mapstream.operators.lidar.trail import Place, Reach, Trail
from mapstream.operators.operator import OperatorConfig, offload, warn
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import (
    LoopCandidate,
    LoopReport,
    MapCorrection,
    RelativePose,
    Submap,
)


class LoopSearchConfig(OperatorConfig):
    """Which places are compared, and which matches are believed."""

    min_keyframes: NonNegativeInt = 20
    """So many keyframes lie between the two ends of a loop."""
    min_path_m: NonNegativeFloat = 15.0
    """So much path lies between the two ends of a loop."""
    max_distance_m: PositiveFloat = 3.0
    """How far apart the two ends may be by the poses known before."""
    drift: NonNegativeFloat = 0.01
    """By so much per metre travelled since a loop closed, `max_distance_m` grows."""
    spacing_m: PositiveFloat = 2.0
    """Path between two searches."""
    neighbours: NonNegativeInt = 4
    """Keyframes on either side whose clouds are merged."""
    min_inlier_fraction: PositiveFloat = 0.6
    """Of the points, for a match to be believed."""
    max_rmse_m: PositiveFloat = 0.06
    """Of the inliers, for a match to be believed."""
    max_turn_deg: PositiveFloat = 25.0
    """How far a match may turn away from the poses known before."""
    sigma_rotation_rad: PositiveFloat = 0.005
    """Uncertainty that every loop has beyond what the registration claims."""
    sigma_translation_m: PositiveFloat = 0.03
    """The same of the position."""
    links: tuple[PositiveInt, ...] = ()
    """Also register each keyframe to those so many before it, for instance `[1, 2]`."""
    max_cloud_bytes: PositiveInt = 128_000_000
    """Memory for clouds; all of them are on disk."""


class PlaceMatcher(Protocol):
    """Anything that finds how the clouds of two places lie to each other."""

    def match(
        self, source: Points, target: Points, T_guess: SE3, radius_m: float
    ) -> RegistrationResult:
        """Find T_target_source within about `radius_m` of the guess.

        Raises:
            EstimationError: If one of the clouds is too small to be matched.
        """
        ...

    def refine(self, source: Points, target: Points, T_guess: SE3) -> RegistrationResult:
        """Find T_target_source close to the guess.

        Raises:
            EstimationError: If one of the clouds is too small to be matched.
        """
        ...


class LoopSearch:
    """The search of one run, over the missions that pass through it.

    Poses are those that the optimizer had after the submap before, never newer ones, so a replay finds the same loops.
    """

    def __init__(self, config: LoopSearchConfig, matcher: PlaceMatcher, source: str) -> None:
        """Begin a search.

        Args:
            config: Where to look, and what to believe.
            matcher: How clouds are compared.
            source: The operator's name, for its edges.
        """
        self._config, self._matcher, self._source = config, matcher, source
        self._gate = Gate(
            min_inlier_fraction=config.min_inlier_fraction,
            max_rmse_m=config.max_rmse_m,
            max_turn_rad=float(np.radians(config.max_turn_deg)),
        )
        self._reach = Reach(
            min_keyframes=config.min_keyframes,
            min_path_m=config.min_path_m,
            distance_m=config.max_distance_m,
            drift=config.drift,
        )
        self._trails: dict[str, Trail] = {}  # by mission
        self._searched_m: dict[str, float] = {}  # by mission: where on the path was searched last

    async def run(
        self,
        submaps: Receiver[Submap],
        corrections: Receiver[MapCorrection] | None,
        reports: Sender[LoopReport],
    ) -> None:
        """Send one report for each submap."""
        newest_ns: dict[str, int] = {}
        with Surroundings(self._config.neighbours, self._config.max_cloud_bytes) as surroundings:
            async for submap in submaps:
                before_ns = newest_ns.get(submap.mission_id)
                if corrections is not None and before_ns is not None:
                    await self._hear(corrections, submap.mission_id, before_ns)
                newest_ns[submap.mission_id] = submap.stamp_ns
                report = await offload(self.search, submap, surroundings)
                await reports.send(report)

    async def _hear(
        self, corrections: Receiver[MapCorrection], mission_id: str, stamp_ns: int
    ) -> None:
        """Wait for the poses that the optimizer had after the submap that ended at this stamp."""
        async for correction in corrections:
            self._trails[correction.mission_id].correct(correction)
            if correction.mission_id == mission_id and correction.stamp_ns >= stamp_ns:
                return
        warn("the optimizer's corrections ended; loops are searched by odometry")

    def search(self, submap: Submap, surroundings: Surroundings) -> LoopReport:
        """Look for loops from the new keyframes of one submap."""
        mission_id = submap.mission_id
        trail = self._trails.setdefault(mission_id, Trail())
        surroundings.keep(submap)
        edges: list[RelativePose] = []
        candidates: list[LoopCandidate] = []
        for index in trail.extend(submap):
            edges += self._links(mission_id, trail, index, surroundings)
            path_m = trail.path_m(index)
            if path_m - self._searched_m.get(mission_id, -np.inf) < self._config.spacing_m:
                continue
            place = trail.seen_before(index, self._reach)
            if place is None:
                continue
            self._searched_m[mission_id] = path_m
            edge, candidate = self._try(mission_id, trail, index, place, surroundings)
            candidates.append(candidate)
            edges += [] if edge is None else [edge]
        return LoopReport(
            stamp_ns=submap.stamp_ns, edges=tuple(edges), candidates=tuple(candidates)
        )

    def _try(
        self, mission_id: str, trail: Trail, index: int, place: Place, surroundings: Surroundings
    ) -> tuple[RelativePose | None, LoopCandidate]:
        """Register a keyframe to a place, and judge the match."""
        T_guess = trail.pose(place.index).inverse() @ trail.pose(index)
        result: RegistrationResult | None = None
        try:
            target = surroundings.around(mission_id, trail, place.index)
            source = surroundings.around(mission_id, trail, index)
            result = self._matcher.match(source, target, T_guess, place.reach_m)
            refusal = self._gate.refusal(result, T_guess, 2 * place.reach_m)
        except EstimationError as error:
            refusal = str(error)
        candidate = LoopCandidate(
            stamp_a_ns=int(trail.stamps_ns[place.index]),
            stamp_b_ns=int(trail.stamps_ns[index]),
            distance_m=place.distance_m,
            verdict=refusal or "accepted",
            inlier_fraction=float("nan") if result is None else result.inlier_fraction,
            rmse_m=float("nan") if result is None else result.rmse_m,
        )
        if refusal or result is None:
            return None, candidate
        trail.close(index)
        return self._edge("loop", mission_id, trail, (place.index, index), result), candidate

    def _links(
        self, mission_id: str, trail: Trail, index: int, surroundings: Surroundings
    ) -> list[RelativePose]:
        """Register a keyframe to the ones before it that the config names."""
        edges = []
        for link in self._config.links:
            if index < link:
                continue
            T_guess = trail.pose(index - link).inverse() @ trail.pose(index)
            try:
                target = surroundings.at(mission_id, trail, index - link)
                source = surroundings.at(mission_id, trail, index)
                result = self._matcher.refine(source, target, T_guess)
                refusal = self._gate.refusal(result, T_guess, self._config.max_distance_m)
            except EstimationError as error:
                warn(f"a keyframe is not registered to one before it: {error}")
                continue
            if refusal:
                warn("a keyframe is not registered to one before it: the match was not believed")
            else:
                ends = (index - link, index)
                edges.append(self._edge("registration", mission_id, trail, ends, result))
        return edges

    def _edge(
        self,
        kind: Any,  # noqa: ANN401  # a literal
        mission_id: str,
        trail: Trail,
        ends: tuple[int, int],
        result: RegistrationResult,
    ) -> RelativePose:
        config = self._config
        floor = np.array([config.sigma_rotation_rad] * 3 + [config.sigma_translation_m] * 3)
        return RelativePose(
            kind=kind,
            mission_a=mission_id,
            stamp_a_ns=int(trail.stamps_ns[ends[0]]),
            mission_b=mission_id,
            stamp_b_ns=int(trail.stamps_ns[ends[1]]),
            T_a_b=result.T_target_source,
            covariance=result.covariance + np.diag(floor**2),
            source=self._source,
            is_switchable=kind == "loop",
        )
