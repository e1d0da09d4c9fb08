"""Robots that all send to one optimizer at once, some of it false or strange."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import anyio
import numpy as np

from mapstream.operators.backend.optimizer import Inputs, Optimizer, OptimizerConfig, Outputs
from mapstream.operators.operator import Context, set_context
from mapstream.recordings.maps.model import Map
from mapstream.streams.channel import Channel, Limits, Receiver, Sender
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import (
    Keyframe,
    LoopReport,
    MapCorrection,
    Odometry,
    RelativePose,
    Submap,
)
from tests.operators.estimation import worlds

_FEW = Limits(capacity=3)  # so that producers wait for the optimizer, and for each other
_LAP = 60  # poses


@dataclass(frozen=True, slots=True, kw_only=True)
class Traffic:
    """How much is sent."""

    num_robots: int = 8
    num_submaps: int = 3  # of each robot
    submap: int = 5  # steps in one
    num_sources: int = 4  # of odometry: edges in parallel
    loop_every: int = 2  # submaps of all robots
    seed: int = 0

    @property
    def num_edges(self) -> int:
        """Of odometry."""
        return self.num_robots * self.num_submaps * self.submap * self.num_sources


@dataclass(slots=True)
class Outcome:
    """What came of it."""

    map: Map
    truth: np.ndarray  # (N, 4, 4) of the map's vertices
    num_corrections: int
    num_loops: int


async def run_traffic(traffic: Traffic) -> Outcome:
    """Let robots send their submaps side by side, in a seeded disorder, until all are through."""
    submaps: Channel[Submap] = Channel("submaps", _FEW)
    loops: Channel[LoopReport] = Channel("loops", _FEW)
    corrections: Channel[MapCorrection] = Channel("corrections", Limits(capacity=2**62))
    maps: Channel[Map] = Channel("maps", Limits(capacity=2**62))
    set_context(Context(name="optimizer"))
    optimizer = Optimizer(OptimizerConfig())
    inputs = Inputs(
        submaps=Receiver(submaps, spans_epochs=True), loops=Receiver(loops, spans_epochs=True)
    )
    outputs = Outputs(corrections=Sender([corrections]), maps=Sender([maps]))
    fleet = _Fleet(traffic)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(optimizer.run, inputs, outputs)
        async with anyio.create_task_group() as robots:
            for robot in range(traffic.num_robots):
                robots.start_soon(fleet.drive, robot, submaps, loops)
        submaps.close()
        loops.close()
    for channel in (corrections, maps):
        channel.close()
    sent = [message async for message in Receiver(corrections, spans_epochs=True)]
    [*_, final] = [message async for message in Receiver(maps, spans_epochs=True)]
    truth = np.array([fleet.truth[stamp_ns % _LAP].matrix for stamp_ns in final.vertices.stamp_ns])
    return Outcome(final, truth, len(sent), fleet.num_loops)


class _Fleet:
    """Robots on one circle; each begins elsewhere."""

    def __init__(self, traffic: Traffic) -> None:
        self.truth = worlds.circle(_LAP, laps=1)
        self.num_loops = 0
        self._traffic = traffic
        self._rng = np.random.default_rng(traffic.seed)
        self._turn = anyio.Lock()
        self._sent: list[tuple[str, int]] = []  # vertices that the optimizer will know first

    async def drive(self, robot: int, submaps: Channel[Submap], loops: Channel[LoopReport]) -> None:
        mission = f"{robot:032x}"
        first = robot * 7
        rng = np.random.default_rng([self._traffic.seed, robot])
        at = SE3.identity()  # odometry's frame is the robot's first pose
        for index in range(self._traffic.num_submaps):
            start = first + index * self._traffic.submap
            submap, at = self._submap(mission, index, start, at, rng)
            for _ in range(int(self._rng.integers(4))):
                await anyio.lowlevel.checkpoint()
            async with self._turn:  # reports come in the order of the submaps
                await submaps.put(submap)
                self._sent += [(mission, keyframe.stamp_ns) for keyframe in submap.keyframes]
                await loops.put(LoopReport(stamp_ns=submap.stamp_ns, edges=self._loops(submap)))

    def _submap(
        self, mission: str, index: int, start: int, at: SE3, rng: np.random.Generator
    ) -> tuple[Submap, SE3]:
        stamps_ns = range(start, start + self._traffic.submap + 1)
        poses, edges = [at], []
        for a, b in pairwise(stamps_ns):
            T_a, T_b = self.truth[a % _LAP], self.truth[b % _LAP]
            steps = [worlds.measured(T_a, T_b, rng) for _ in range(self._traffic.num_sources)]
            edges += [
                replace(worlds.edge(a, b, step, mission=mission), source=f"odometry{source}")
                for source, step in enumerate(steps)
            ]
            poses.append(poses[-1] @ steps[0])
        frames = tuple(
            Keyframe(stamp_ns=ns, odometry=Odometry(stamp_ns=ns, T_odom_base=pose))
            for ns, pose in zip(stamps_ns, poses, strict=True)
        )
        return Submap(mission_id=mission, index=index, keyframes=frames, edges=tuple(edges)), poses[
            -1
        ]

    def _loops(self, submap: Submap) -> tuple[RelativePose, ...]:
        """Return nothing, true loops to whatever was sent before, false ones, and far too certain false ones."""
        rng = self._rng
        if len(self._sent) < 2 or rng.integers(self._traffic.loop_every):
            return ()
        b = submap.keyframes[-1].stamp_ns
        mission_a, a = self._sent[int(rng.integers(len(self._sent)))]
        if (mission_a, a) == (submap.mission_id, b):
            return ()
        T_a_b = worlds.measured(self.truth[a % _LAP], self.truth[b % _LAP], rng)
        true = replace(
            worlds.edge(a, b, T_a_b, kind="loop"), mission_a=mission_a, mission_b=submap.mission_id
        )
        false = replace(
            worlds.false_loop(a, b, rng), mission_a=mission_a, mission_b=submap.mission_id
        )
        sure = replace(false, covariance=false.covariance * 1e-6)
        kinds = ((true,), (true, true), (true, false), (false,), (sure,))
        chosen = kinds[int(rng.choice(5, p=[0.4, 0.2, 0.2, 0.1, 0.1]))]
        self.num_loops += len(chosen)
        return chosen
