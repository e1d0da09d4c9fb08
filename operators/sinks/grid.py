"""Occupancy grids as files that robots drive by."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from mapstream.operators.operator import (
    NoPorts,
    Operator,
    OperatorConfig,
    Placement,
    offload,
    report_written,
)
from mapstream.recordings.grid_files import write_grid
from mapstream.streams.channel import Receiver
from mapstream.streams.messages.grids import OccupancyGrid


class GridSinkConfig(OperatorConfig):
    path: Path = Field(
        default=Path("grid.yaml"), description="the YAML file; its image is written beside it"
    )


@dataclass(frozen=True)
class Inputs:
    grids: Receiver[OccupancyGrid]


class GridSink(Operator[Inputs, NoPorts]):
    """Write each grid that comes, as ROS' map_server reads it, in place of the one before."""

    placement: ClassVar[Placement] = "thread"
    spans_epochs: ClassVar[bool] = True

    def __init__(self, config: GridSinkConfig) -> None:
        self._path = config.path

    async def run(self, inputs: Inputs, outputs: NoPorts) -> None:  # noqa: ARG002  # a sink
        async for grid in inputs.grids:
            await offload(write_grid, self._path, grid)
            report_written(self._path)
