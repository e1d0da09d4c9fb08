"""Loop closure of a planar laser by matching scans to those of nearby places.

Source: Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section IV-C (its Canonical Scan Matcher plugin); the matching:
Censi, ICRA 2008; the search around the guess: Olson, ICRA 2009.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat

from mapstream.operators.laser.matching import MatchConfig
from mapstream.operators.laser.place_matching import PlanarMatcher
from mapstream.operators.lidar.loop_search import LoopSearch, LoopSearchConfig
from mapstream.operators.operator import Operator, Placement
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.estimates import LoopReport, MapCorrection, Submap


class LaserLoopsConfig(LoopSearchConfig):
    """Options of `laser_loops`."""

    min_path_m: NonNegativeFloat = 10.0
    """So much path lies between the two ends of a loop."""
    max_distance_m: PositiveFloat = 2.0
    """How far apart the two ends may be by the poses known before."""
    drift: NonNegativeFloat = 0.03
    """By so much per metre travelled since a loop closed, `max_distance_m` grows."""
    spacing_m: PositiveFloat = 1.0
    """Path between two searches."""
    neighbours: NonNegativeInt = 8
    """Keyframes on either side whose scans are merged."""
    overlap_radius_m: PositiveFloat = 4.0
    """Points so near the robot must fit; what lies farther away may have been in sight only once."""
    min_inlier_fraction: PositiveFloat = 0.6
    """Of the points within that radius, for a match to be believed."""
    cell_m: PositiveFloat = 0.05
    """One point is compared in each."""
    search_distance_m: PositiveFloat = 0.4
    """How far apart matching points may lie at first."""
    inlier_distance_m: PositiveFloat = 0.08
    """How far from the line a point may lie to count as an inlier."""


@dataclass(frozen=True)
class Inputs:
    """Submaps whose keyframes have the scans as clouds, and after each of them the optimizer's correction."""

    submaps: Receiver[Submap]
    corrections: Receiver[MapCorrection] | None = None


@dataclass(frozen=True)
class Outputs:
    """One report for each submap, whether it closes a loop or not."""

    loops: Sender[LoopReport]


class LaserLoops(Operator[Inputs, Outputs]):
    """Find places that a planar laser saw before, and match what was seen there.

    The nearest keyframe far enough in the past is the candidate; how near it must be grows with the drift since
    then. What was seen around both is compared on a grid of poses, and the best of them is refined by lines. A match
    with enough inliers, a small residual, a plausible pose and a hold along every direction becomes a loop edge that
    the optimizer may switch off; any other adds nothing, and the report says why.
    """

    placement: ClassVar[Placement] = "thread"  # KD-trees and OpenCV free the interpreter
    spans_epochs: ClassVar[bool] = True

    def __init__(self, config: LaserLoopsConfig) -> None:
        matcher = PlanarMatcher(
            turn_rad=float(np.radians(config.max_turn_deg)),
            overlap_radius_m=config.overlap_radius_m,
            cell_m=config.cell_m,
            config=MatchConfig(
                search_distance_m=config.search_distance_m,
                inlier_distance_m=config.inlier_distance_m,
            ),
            ground_sigma_rad=config.sigma_rotation_rad,
            ground_sigma_m=config.sigma_translation_m,
        )
        self._search = LoopSearch(config, matcher, "laser_loops")

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        await self._search.run(inputs.submaps, inputs.corrections, outputs.loops)
