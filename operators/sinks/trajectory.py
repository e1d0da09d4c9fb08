"""The end of a mapping graph: the trajectory goes to a text file when the run ends."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import anyio
import numpy as np
from pydantic import Field

from mapstream.operators.operator import (
    NoPorts,
    Operator,
    OperatorConfig,
    offload,
    report_written,
    warn,
)
from mapstream.recordings.maps.model import Map
from mapstream.recordings.trajectory_files import write_euroc, write_kitti, write_tum
from mapstream.streams.channel import Receiver
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.trajectory import Trajectory

Format = Literal["tum", "kitti", "euroc"]
_WRITERS: dict[Format, Callable[[Path, Trajectory], None]] = {
    "tum": write_tum,
    "kitti": write_kitti,
    "euroc": write_euroc,
}


class TrajectorySinkConfig(OperatorConfig):
    path: Path = Field(
        default=Path("trajectory.tum"), description="the file, replaced if it exists"
    )
    format: Format = Field(default="tum", description="kitti keeps no stamps")


@dataclass(frozen=True)
class Inputs:
    maps: Receiver[Map] | None = None
    odometry: Receiver[Odometry] | None = None


class TrajectorySink(Operator[Inputs, NoPorts]):
    """Write the poses of the newest map, in the map frame; without a map, those of the odometry.

    Several missions, or several epochs of odometry, become several files with the mission or epoch in
    their names. A file is written whole or not at all.
    """

    placement = "thread"
    spans_epochs = True

    def __init__(self, config: TrajectorySinkConfig) -> None:
        self.config = config
        self._newest: Map | None = None
        self._epochs: dict[int, list[Odometry]] = {}

    async def run(self, inputs: Inputs, outputs: NoPorts) -> None:  # noqa: ARG002  # a sink
        async with anyio.create_task_group() as tasks:
            if inputs.maps is not None:
                tasks.start_soon(self._keep_newest, inputs.maps)
            if inputs.odometry is not None:
                tasks.start_soon(self._collect, inputs.odometry)
        trajectories = self._of_map() if self._newest is not None else self._of_odometry()
        if not trajectories:
            warn(f"no pose came, so {self.config.path} was not written")
            return
        await offload(self._write, trajectories)

    async def _keep_newest(self, maps: Receiver[Map]) -> None:
        async for map_ in maps:
            self._newest = map_

    async def _collect(self, odometry: Receiver[Odometry]) -> None:
        async for message in odometry:
            epoch = self._epochs.setdefault(odometry.epoch, [])
            if epoch and message.stamp_ns <= epoch[-1].stamp_ns:
                warn("odometry whose stamp does not increase was left out of the trajectory")
                continue
            epoch.append(message)

    def _of_map(self) -> dict[str, Trajectory]:
        map_ = self._newest or Map.empty()
        trajectories = {}
        for row in range(len(map_.missions)):
            vertices = map_.vertices_of(row)
            if len(vertices):
                trajectories[map_.mission_id(row)[:8]] = Trajectory(
                    stamps_ns=map_.vertices.stamp_ns[vertices], poses=map_.T_map_base(vertices)
                )
        return trajectories

    def _of_odometry(self) -> dict[str, Trajectory]:
        return {
            f"epoch{epoch}": Trajectory(
                stamps_ns=np.array([message.stamp_ns for message in messages]),
                poses=np.array([message.T_odom_base.matrix for message in messages]),
            )
            for epoch, messages in self._epochs.items()
        }

    def _write(self, trajectories: Mapping[str, Trajectory]) -> None:
        path, write = self.config.path, _WRITERS[self.config.format]
        for name, trajectory in trajectories.items():
            is_only = len(trajectories) == 1
            file = path if is_only else path.with_stem(f"{path.stem}-{name}")
            write(file, trajectory)
            report_written(file)
