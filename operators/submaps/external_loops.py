"""Loop closures that others found, put into the graph that maps (maplab 2.0, section III-A1)."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np
from pydantic import Field

from mapstream.operators.maps.external_loops import End, checked, edge_between, end_at
from mapstream.operators.operator import Operator, OperatorConfig, report_loss, warn
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import MapError
from mapstream.streams.messages.constraints import LoopClosure
from mapstream.streams.messages.estimates import (
    Keyframe,
    LoopCandidate,
    LoopReport,
    RelativePose,
    Submap,
)
from mapstream.streams.sync import merge
from mapstream.streams.trajectory import Trajectory


class ExternalLoopsConfig(OperatorConfig):
    """Options of `external_loops`."""

    min_quality: float = 0.0
    """Loops of a lower quality are rejected."""
    robots: dict[str, str] = Field(default_factory=dict)
    """By the names that loops use: the first digits of a mission's id; none where there is one robot alone."""


@dataclass(frozen=True)
class Inputs:
    """Loops, the submaps between whose keyframes they become edges, and what another search found."""

    loops: Receiver[LoopClosure]
    submaps: Receiver[Submap]
    reports: Receiver[LoopReport] | None


@dataclass(frozen=True)
class Outputs:
    """One report for each submap: the loops whose ends are there since, and why others were rejected."""

    loops: Sender[LoopReport]


class ExternalLoops(Operator[Inputs, Outputs]):
    """Make each loop one edge between the nearest keyframes, by the odometry around its exact stamps.

    A loop waits until the submaps reach both its ends. Each rejected one is in the report, with the reason.
    """

    spans_epochs: ClassVar[bool] = True

    def __init__(self, config: ExternalLoopsConfig) -> None:
        self._config = config
        self._tracks: dict[str, _Track] = {}  # by mission
        self._waiting: list[LoopClosure] = []

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        reports = None if inputs.reports is None else aiter(inputs.reports)
        async for port, message in merge(inputs.loops, inputs.submaps):
            if port == 0 and isinstance(message, LoopClosure):
                self._waiting.append(message)
            elif isinstance(message, Submap):
                self.add(message)
                found = self.report(message.stamp_ns)
                other = None if reports is None else await anext(reports, None)
                await outputs.loops.send(found if other is None else _joined(found, other))
        for loop in self._waiting:
            report_loss(f"a loop that found no place: {self._why_it_waits(loop)}")

    def add(self, submap: Submap) -> None:
        """Take the keyframes of a submap in."""
        track = self._tracks.setdefault(submap.mission_id, _Track())
        for keyframe in (*submap.keyframes, *(splice.keyframe for splice in submap.splices)):
            track.add(keyframe)

    def report(self, stamp_ns: int) -> LoopReport:
        """Return what becomes of the loops whose ends are known by now; the others go on waiting."""
        edges: list[RelativePose] = []
        candidates: list[LoopCandidate] = []
        waiting: list[LoopClosure] = []
        for loop in self._waiting:
            verdict = "accepted"
            try:
                measured = checked(loop, self._config.min_quality)
                if self._why_it_waits(loop):
                    waiting.append(loop)
                    continue
                ends = (
                    self._end(loop.robot_a, loop.stamp_a_ns),
                    self._end(loop.robot_b, loop.stamp_b_ns),
                )
                edges.append(edge_between(measured, *ends))
            except MapError as error:
                verdict = str(error)
                warn(f"a loop was rejected: {verdict}")
            candidates.append(_candidate(loop, verdict))
        self._waiting = waiting
        return LoopReport(stamp_ns=stamp_ns, edges=tuple(edges), candidates=tuple(candidates))

    def _why_it_waits(self, loop: LoopClosure) -> str:
        """Return what has not come yet; empty if nothing."""
        for robot, stamp_ns in ((loop.robot_a, loop.stamp_a_ns), (loop.robot_b, loop.stamp_b_ns)):
            missions = self._missions(robot)
            if not missions:
                return f"no mission of robot {robot!r} came; there are {sorted(self._tracks)}"
            if stamp_ns > max(self._tracks[mission].last_ns for mission in missions):
                return f"mission {missions[-1]} ends before {stamp_ns} ns"
        return ""

    def _missions(self, robot: str) -> list[str]:
        """Return the missions that a robot's name may mean, in the order of time."""
        digits = self._config.robots.get(robot, robot)
        found = [mission for mission in self._tracks if mission.startswith(digits)]
        return sorted(found, key=lambda mission: self._tracks[mission].first_ns)

    def _end(self, robot: str, stamp_ns: int) -> End:
        """Return an end of a loop, in the one mission of the robot that was at that time.

        Raises:
            MapError: If there is none, or there are several.
        """
        missions = self._missions(robot)
        spans = [(self._tracks[m].first_ns, self._tracks[m].last_ns) for m in missions]
        if any(first[1] >= second[0] for first, second in pairwise(spans)):
            raise MapError(f"several missions are called {robot!r} at the same time: {missions}")
        at = [m for m, (a, b) in zip(missions, spans, strict=True) if a <= stamp_ns <= b]
        if len(missions) > 1 and not at:
            raise MapError(f"{stamp_ns} ns lies in none of the missions of {robot!r}: {missions}")
        mission = at[0] if at else missions[0]
        return end_at(mission, self._tracks[mission].trajectory(), stamp_ns)


class _Track:
    """The keyframes of one mission, along its odometry."""

    def __init__(self) -> None:
        self._stamps_ns: list[int] = []
        self._poses: list[np.ndarray[tuple[int, int], np.dtype[np.float64]]] = []
        self._trajectory: Trajectory | None = None

    @property
    def first_ns(self) -> int:
        return self._stamps_ns[0]

    @property
    def last_ns(self) -> int:
        return self._stamps_ns[-1]

    def add(self, keyframe: Keyframe) -> None:
        at = bisect_left(self._stamps_ns, keyframe.stamp_ns)
        if at < len(self._stamps_ns) and self._stamps_ns[at] == keyframe.stamp_ns:
            return  # the first keyframe of a submap is the last one of the submap before
        self._stamps_ns.insert(at, keyframe.stamp_ns)
        self._poses.insert(at, keyframe.odometry.T_odom_base.matrix)
        self._trajectory = None

    def trajectory(self) -> Trajectory:
        if self._trajectory is None:
            stamps_ns = np.array(self._stamps_ns, dtype=np.int64)
            self._trajectory = Trajectory(stamps_ns=stamps_ns, poses=np.array(self._poses))
        return self._trajectory


def _candidate(loop: LoopClosure, verdict: str) -> LoopCandidate:
    return LoopCandidate(
        stamp_a_ns=loop.stamp_a_ns,
        stamp_b_ns=loop.stamp_b_ns,
        distance_m=float(np.linalg.norm(loop.T_a_b.t)),
        verdict=verdict,
    )


def _joined(found: LoopReport, other: LoopReport) -> LoopReport:
    return LoopReport(
        stamp_ns=found.stamp_ns,
        edges=(*other.edges, *found.edges),
        candidates=(*other.candidates, *found.candidates),
    )
