"""The end of a mapping graph: what was seen becomes a mesh, where the last map's poses put it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from mapstream.operators.dense.mesh import MeshConfig, make_mesh
from mapstream.operators.maps.passing_clouds import PassingClouds
from mapstream.operators.operator import (
    NoPorts,
    Operator,
    OptionalPath,
    Placement,
    offload,
    report_written,
    warn,
)
from mapstream.recordings.maps.model import Map
from mapstream.streams.channel import Receiver
from mapstream.streams.errors import MapError
from mapstream.streams.messages.estimates import Submap


class MeshSinkConfig(MeshConfig):
    """Options of `mesh_sink`: those of `mapstream map DIR mesh`, and the file."""

    path: OptionalPath = Field(
        default=Path("mesh.ply"), description="the file, .ply or .glb, replaced; empty: none"
    )


@dataclass(frozen=True)
class Inputs:
    """Maps whose vertices refer to recorded depth images; or the submaps with their clouds."""

    maps: Receiver[Map]
    submaps: Receiver[Submap] | None


class MeshSink(Operator[Inputs, NoPorts]):
    """Keep clouds on disk, and fuse them, or the recorded depth images, when the run is over.

    So a loop closure at the end of the run moves the walls that were seen at its beginning. Depth images are read
    again from the recording; a run from live sensors has none, and needs clouds.
    """

    placement: ClassVar[Placement] = "thread"
    spans_epochs: ClassVar[bool] = True

    def __init__(self, config: MeshSinkConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: NoPorts) -> None:  # noqa: ARG002  # a sink
        with PassingClouds() as clouds:
            newest = await clouds.gather(inputs.maps, inputs.submaps)
            path = self._config.path
            if path is None:
                return
            if newest is None:
                warn(f"no map came, so {path} was not written")
                return
            try:
                await offload(make_mesh, clouds.put_into(newest), clouds.folder, path, self._config)
            except MapError as error:  # the map itself is whole
                warn(f"{path} was not written: {error}")
                return
            report_written(path)
