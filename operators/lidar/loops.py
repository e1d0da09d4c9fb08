"""LiDAR loop closure (Trevor, Rogers, Christensen: OmniMapper, ICRA 2014, section IV-C1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from mapstream.operators.lidar.aligning import AligningConfig
from mapstream.operators.lidar.loop_matcher import LoopMatcher
from mapstream.operators.lidar.loop_search import LoopSearch, LoopSearchConfig
from mapstream.operators.operator import Operator, Placement
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.estimates import LoopReport, MapCorrection, Submap


class LidarLoopsConfig(LoopSearchConfig, AligningConfig):
    """Options of `lidar_loops`."""


@dataclass(frozen=True)
class Inputs:
    """Submaps, and after each of them the optimizer's correction."""

    submaps: Receiver[Submap]
    corrections: Receiver[MapCorrection] | None = None


@dataclass(frozen=True)
class Outputs:
    """One report for each submap, whether it closes a loop or not."""

    loops: Sender[LoopReport]


class LidarLoops(Operator[Inputs, Outputs]):
    """Find places that were seen before, and register the clouds around them.

    The nearest keyframe far enough in the past is the candidate; how near it must be grows with the drift
    since then. The clouds around both are aligned from many starts. A match with enough inliers, a small
    residual and a plausible pose becomes a loop edge that the optimizer may switch off; any other adds
    nothing, and the report says why. Poses are those that the optimizer had after the submap before, never
    newer ones, so a replay finds the same loops.
    """

    placement: ClassVar[Placement] = "process"  # small_gicp holds the GIL
    spans_epochs: ClassVar[bool] = True

    def __init__(self, config: LidarLoopsConfig) -> None:
        fine, coarse = config.make_registration(), config.make_registration(2.0)
        self._search = LoopSearch(config, LoopMatcher(fine, coarse, grid_m=1.5), "lidar_loops")

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        await self._search.run(inputs.submaps, inputs.corrections, outputs.loops)
