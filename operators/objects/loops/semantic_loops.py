"""Semantic loop closure while a map grows (Cramariuc et al., maplab 2.0, RA-L 2023, section IV-D)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from pydantic import Field

from mapstream.operators.objects.landmarks.object_landmarks import (
    ObjectLandmarksConfig,
    object_landmarks,
)
from mapstream.operators.objects.loops.search import (
    ObjectSearch,
    SearchConfig,
    Searched,
)
from mapstream.operators.operator import Operator, Placement, offload
from mapstream.operators.submaps.corrected_map import CorrectedMap
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.estimates import (
    LoopCandidate,
    LoopReport,
    MapCorrection,
    Submap,
)


class SemanticLoopsConfig(SearchConfig):
    """Options of `semantic_loops`."""

    landmarks: ObjectLandmarksConfig = Field(
        default_factory=lambda: ObjectLandmarksConfig(max_gap_s=10.0)
    )
    """When tracks are of one object; what is seen again later must stay another one, and what drift smears may be more."""


@dataclass(frozen=True)
class Inputs:
    """Submaps whose keyframes have objects, and after each of them the optimizer's correction."""

    submaps: Receiver[Submap]
    corrections: Receiver[MapCorrection] | None = None


@dataclass(frozen=True)
class Outputs:
    """One report for each submap, whether it closes a loop or not."""

    loops: Sender[LoopReport]


class SemanticLoops(Operator[Inputs, Outputs]):
    """Recognise places by their objects: as many of the same classes, as far apart as they were.

    Objects of each submap are compared with those seen long before, by this mission or others. What most agree
    on becomes a loop edge that the optimizer may switch off; the report has each pair of objects with the reason.
    """

    placement: ClassVar[Placement] = "thread"
    spans_epochs: ClassVar[bool] = True

    def __init__(self, config: SemanticLoopsConfig) -> None:
        self._config = config
        self._corrected = CorrectedMap()

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for submap in inputs.submaps:
            await self._corrected.follow(inputs.corrections, submap)
            await outputs.loops.send(await offload(self.search, submap))

    def search(self, submap: Submap) -> LoopReport:
        """Look for loops from the objects of one submap."""
        new = self._corrected.append(submap)
        map_, _ = object_landmarks(self._corrected.map, self._config.landmarks)
        self._corrected.map = map_
        searched = ObjectSearch(map_, self._config).search(new)
        return LoopReport(
            stamp_ns=submap.stamp_ns,
            edges=tuple(self._corrected.loop(loop.edge) for loop in searched.loops),
            candidates=tuple(_candidates(searched)),
        )


def _candidates(searched: Searched) -> list[LoopCandidate]:
    """Return what became of each pair of objects, at the times when one was seen last and the other first."""
    objects, found = searched.objects, searched.candidates
    num_of = {int(pair): len(loop.pairs) for loop in searched.loops for pair in loop.pairs}
    rmse_of = {int(p): loop.agreement.rmse_m for loop in searched.loops for p in loop.pairs}
    return [
        LoopCandidate(
            stamp_a_ns=int(objects.last_ns[a]),
            stamp_b_ns=int(objects.first_ns[b]),
            distance_m=float(found.distance_m[row]),
            verdict=str(found.verdict[row]),
            rmse_m=rmse_of.get(row, float("nan")),
            num_matches=len(found.a),
            num_inliers=num_of.get(row, 0),
            score=float(found.alikeness[row]),
        )
        for row, (a, b) in enumerate(zip(found.a.tolist(), found.b.tolist(), strict=True))
    ]
