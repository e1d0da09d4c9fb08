"""Where a local map lies among places: a recogniser proposes, and registration confirms or refuses.

Proposals by looks are right to some decimetres; no guess of a pose is needed.
Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-D ("visual or LiDAR" loop closure on its server).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.lidar.aligning import AligningConfig
from mapstream.operators.lidar.loop_matcher import Gate, LoopMatcher
from mapstream.operators.lidar.places.recognizers import Proposal, make_recognizer
from mapstream.operators.lidar.registration import RegistrationResult
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError

ACCEPTED = "accepted"
_GRID_M = 1.5  # of the starts around a proposal


class PlaceMatchingConfig(AligningConfig):
    """How places are recognised, and what is believed."""

    recognizer: str = "birds_eye"
    """What proposes places: birds_eye, map_closures (an extra), or an installed recogniser."""
    recognizer_options: dict[str, Any] = Field(default_factory=dict)
    """Its options."""
    num_proposals: PositiveInt = 2
    """The likeliest, that are registered."""
    shift_m: NonNegativeFloat = 0.0
    """How far beyond a proposal registration begins, too; 0: only there."""
    min_inlier_fraction: PositiveFloat = 0.6
    """Of the points, for a place to be believed; corridors of another building that are alike reach 0.47."""
    max_rmse_m: PositiveFloat = 0.1
    """Of the inliers."""
    max_sigma_m: PositiveFloat = 0.3
    """How uncertain the position may be by the registration."""
    max_shift_m: PositiveFloat = 2.0
    """How far registration may lead away from the proposal."""
    max_turn_deg: PositiveFloat = 10.0
    """How far it may turn away from it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """A proposal, and what registration says of it."""

    proposal: Proposal
    result: RegistrationResult | None  # None where the clouds could not be registered
    verdict: str  # "accepted", or the reason


class PlaceMatcher:
    """Places with their looks, and the registration that judges what they propose.

    Args:
        config: How, and what is believed.
        points_at: Returns the local map (N, 3) of a place by its key, in the frame of its base.
    """

    def __init__(self, config: PlaceMatchingConfig, points_at: Callable[[int], FloatArray]) -> None:
        self._config, self._points_at = config, points_at
        self._recognizer = make_recognizer(config.recognizer, config.recognizer_options)
        fine, coarse = config.make_registration(), config.make_registration(2.0)
        self._matcher = LoopMatcher(fine, coarse, grid_m=_GRID_M)
        self._gate = Gate(
            min_inlier_fraction=config.min_inlier_fraction,
            max_rmse_m=config.max_rmse_m,
            max_turn_rad=float(np.radians(config.max_turn_deg)),
            max_sigma_m=config.max_sigma_m,
        )

    def add(self, key: int) -> None:
        """Take in a place by its local map.

        Raises:
            EstimationError: If it cannot be looked at.
        """
        self._recognizer.add(key, self._points_at(key))

    def recognize(self, points: FloatArray) -> list[Judged]:
        """Return what became of the likeliest places for a local map (N, 3): the last one may be accepted.

        Raises:
            EstimationError: If the local map cannot be looked at.
        """
        judged: list[Judged] = []
        for proposal in self._recognizer.propose(points)[: self._config.num_proposals]:
            judged.append(self._judge(points, proposal))
            if judged[-1].verdict == ACCEPTED:
                break
        return judged

    def _judge(self, points: FloatArray, proposal: Proposal) -> Judged:
        T_guess, target = proposal.T_place_query, self._points_at(proposal.key)
        try:
            result = self._matcher.match(points, target, T_guess, self._config.shift_m)
        except EstimationError as error:
            return Judged(proposal=proposal, result=None, verdict=str(error))
        refusal = self._gate.refusal(result, T_guess, self._config.max_shift_m)
        return Judged(proposal=proposal, result=result, verdict=refusal or ACCEPTED)
