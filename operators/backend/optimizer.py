"""The one owner of a running graph's map and of the problem behind it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from pydantic import NonNegativeInt

from mapstream.operators.backend.live_map import LiveMap
from mapstream.operators.estimation.batch import OptimizeConfig
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.recordings.maps.model import Map
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import LoopReport, MapCorrection, Submap


class OptimizerConfig(OperatorConfig):
    """Options of `optimizer`."""

    map_every_submaps: NonNegativeInt = 0
    """The map is sent after so many submaps; 0: once, at the end."""
    initial_position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the first mission's frame lies in the map."""
    initial_quat_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """How the first mission's frame is turned in the map."""
    batch: OptimizeConfig = OptimizeConfig()
    """How the whole map is optimised, at the end and when loops contradict each other."""


@dataclass(frozen=True)
class Inputs:
    """Submaps in order, and one report of loops for each, if loops are searched for."""

    submaps: Receiver[Submap]
    loops: Receiver[LoopReport] | None


@dataclass(frozen=True)
class Outputs:
    """After every optimisation the corrected poses, now and then and at the end the map."""

    corrections: Sender[MapCorrection]
    maps: Sender[Map]


class Optimizer(Operator[Inputs, Outputs]):
    """Put submaps and loops into one factor graph, and keep it solved.

    It is incremental (iSAM2) while submaps come, and optimises the whole map once at the end.
    Every submap gives one correction; a new mission begins where a submap of another mission comes.
    """

    placement: ClassVar[Placement] = "process"  # gtsam holds the interpreter for its whole call
    spans_epochs: ClassVar[bool] = True

    def __init__(self, config: OptimizerConfig) -> None:
        self._config = config
        T_map_first = SE3.from_quat_xyzw(config.initial_quat_xyzw, config.initial_position_m)
        self._live = LiveMap(config.batch, T_map_first)

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        every = self._config.map_every_submaps
        num_submaps = 0
        async for submap in inputs.submaps:
            await offload(self._live.append, submap)
            if inputs.loops is not None:
                await self._close_loops(inputs.loops, submap)
            await outputs.corrections.send(self._live.correction(submap.mission_id))
            num_submaps += 1
            if every and num_submaps % every == 0:
                await outputs.maps.send(self._live.ordered())
        if not num_submaps:
            warn("no submap came, so there is no map")
            return
        report = await offload(self._live.finish)
        if self._live.refused:
            warn(f"the last optimisation of the whole map did not count: {self._live.refused}")
        for row in () if self._live.refused else report.switched_off:
            warn(f"loop closure {row} contradicts the rest and was switched off")
        await outputs.maps.send(self._live.ordered())

    async def _close_loops(self, loops: Receiver[LoopReport], submap: Submap) -> None:
        """Take the report on this submap; reports come in the order of the submaps."""
        report = await anext(aiter(loops), None)
        if report is None:
            warn("the search for loops ended before the submaps did")
        elif report.stamp_ns != submap.stamp_ns:
            warn("a report of loops belongs to another submap; it was used all the same")
        if report is not None:
            await offload(self._live.close_loops, report.edges)
