"""The occupancy grid of a map while it grows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import anyio

from mapstream.operators.laser.map_grid import GridConfig, map_grid
from mapstream.operators.maps.passing_clouds import PassingClouds
from mapstream.operators.operator import (
    Operator,
    Placement,
    offload,
    warn,
)
from mapstream.recordings.maps.model import Map
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import MapError
from mapstream.streams.messages.estimates import Submap
from mapstream.streams.messages.grids import OccupancyGrid


@dataclass(frozen=True)
class Inputs:
    """Maps as they grow, and the clouds of their keyframes."""

    maps: Receiver[Map]
    submaps: Receiver[Submap]


@dataclass(frozen=True)
class Outputs:
    grids: Sender[OccupancyGrid]  # one per map; of maps that come faster only the newest


class OccupancyGrids(Operator[Inputs, Outputs]):
    """Draw the floor plan of each map anew, for poses of old keyframes move as well."""

    placement: ClassVar[Placement] = "thread"
    spans_epochs: ClassVar[bool] = True

    def __init__(self, config: GridConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        with PassingClouds() as clouds:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._keep, inputs.submaps, clouds)
                async for map_ in inputs.maps:
                    newest: Map = map_
                    while (later := inputs.maps.try_receive()) is not None:
                        newest = later
                    await clouds.wait_for(newest)
                    try:
                        grid = await offload(self.drawn, newest, clouds)
                    except MapError as error:
                        warn(f"a map without a grid: {error}")
                        continue
                    await outputs.grids.send(grid)

    async def _keep(self, submaps: Receiver[Submap], clouds: PassingClouds) -> None:
        async for submap in submaps:
            await offload(clouds.keep, submap)
            clouds.tell()
        clouds.end()

    def drawn(self, map_: Map, clouds: PassingClouds) -> OccupancyGrid:
        """Return the grid of a map.

        Raises:
            MapError: If the map has no clouds, or the grid would be too large.
        """
        return map_grid(clouds.put_into(map_), clouds.folder, self._config)[0]
