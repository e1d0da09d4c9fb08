"""Operators that send one of everything that can be drawn, for tests of the tap and the viewer."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import anyio.lowlevel

from mapstream.graph.plan import Plan
from mapstream.operators.operator import NoPorts, Operator, OperatorConfig
from mapstream.recordings.maps import Map
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.estimates import (
    Keyframe,
    LoopReport,
    MapCorrection,
    Odometry,
    PointCloud,
    Submap,
)
from mapstream.streams.messages.sensors import CameraFrame, LidarScan
from tests.graph import made_messages as made
from tests.graph.made_plans import make_plan, node


class DriveConfig(OperatorConfig):
    num_steps: int = 12
    num_points: int = 50


@dataclass(frozen=True)
class DriveOutputs:
    scans: Sender[LidarScan]
    frames: Sender[CameraFrame]
    odometry: Sender[Odometry]
    clouds: Sender[PointCloud]
    keyframes: Sender[Keyframe]
    submaps: Sender[Submap]
    loops: Sender[LoopReport]
    corrections: Sender[MapCorrection]
    maps: Sender[Map]


class Drive(Operator[NoPorts, DriveOutputs]):
    """Send what a run on a short drive would send."""

    def __init__(self, config: DriveConfig) -> None:
        self._config = config

    async def run(self, inputs: NoPorts, outputs: DriveOutputs) -> None:
        for step in range(self._config.num_steps):
            stamp_ns = step * made.STEP_NS
            await outputs.scans.send(made.scan(stamp_ns, self._config.num_points))
            await outputs.frames.send(made.camera_frame(stamp_ns=stamp_ns))
            await outputs.odometry.send(made.odometry(step))
            await outputs.clouds.send(made.cloud(stamp_ns, self._config.num_points))
            await outputs.keyframes.send(made.keyframe(step))
            if step % 3 == 0 and step > 0:
                await outputs.submaps.send(made.submap(step // 3 - 1))
                await outputs.loops.send(made.loop_report())
                await outputs.corrections.send(made.correction(step))
                await outputs.maps.send(made.made_map())
            await anyio.lowlevel.checkpoint()


@dataclass(frozen=True)
class ReadInputs:
    messages: Receiver[Any]


class Read(Operator[ReadInputs, NoPorts]):
    """Read and forget."""

    async def run(self, inputs: ReadInputs, outputs: NoPorts) -> None:
        async for _ in inputs.messages:
            pass


def drive_plan(**config: Any) -> Plan:  # noqa: ANN401  # of the drive
    """Return a plan with one source of everything, and a reader per output."""
    ports = [field.name for field in fields(DriveOutputs)]
    nodes = {"drive": node(Drive, **config)}
    nodes |= {f"read_{port}": node(Read) for port in ports}
    return make_plan(nodes, *(f"drive.{port} -> read_{port}.messages" for port in ports))
