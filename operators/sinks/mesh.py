"""The end of a mapping graph: what was seen becomes a mesh, where the last map's poses put it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import anyio
import numpy as np
from pydantic import Field

from mapstream.operators.dense.mesh import MeshConfig, make_mesh
from mapstream.operators.operator import (
    NoPorts,
    Operator,
    OptionalPath,
    Placement,
    offload,
    report_written,
    warn,
)
from mapstream.recordings.cloud_store import CloudStore, cloud_key
from mapstream.recordings.maps.build import add_resources
from mapstream.recordings.maps.ids import id_bytes, vertex_id
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
        self._newest: Map | None = None
        self._files: dict[bytes, str] = {}  # vertex id -> file in the store's folder

    async def run(self, inputs: Inputs, outputs: NoPorts) -> None:  # noqa: ARG002  # a sink
        with CloudStore(max_bytes=0) as store:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._keep_newest, inputs.maps)
                if inputs.submaps is not None:
                    tasks.start_soon(self._keep_clouds, inputs.submaps, store)
            if self._config.path is not None:
                await self._finish(self._config.path, store.directory)

    async def _finish(self, path: Path, folder: Path) -> None:
        if self._newest is None:
            warn(f"no map came, so {path} was not written")
            return
        try:
            await offload(self._write, self._newest, folder, path)
        except MapError as error:  # the map itself is whole
            warn(f"{path} was not written: {error}")
            return
        report_written(path)

    async def _keep_newest(self, maps: Receiver[Map]) -> None:
        async for map_ in maps:
            self._newest = map_

    async def _keep_clouds(self, submaps: Receiver[Submap], store: CloudStore) -> None:
        async for submap in submaps:
            await offload(self._put, submap, store)

    def _put(self, submap: Submap, store: CloudStore) -> None:
        mission = id_bytes(submap.mission_id)
        for keyframe in submap.keyframes if self._config.path is not None else ():
            vertex = vertex_id(mission, keyframe.stamp_ns)
            if keyframe.cloud is not None and vertex not in self._files:
                key = cloud_key(submap.mission_id, keyframe.stamp_ns)
                store.put(key, keyframe.cloud)
                self._files[vertex] = store.path_of(key).name

    def _write(self, map_: Map, folder: Path, path: Path) -> None:
        owners = [i.tobytes() for i in map_.vertices.id]
        rows = [row for row, vertex in enumerate(owners) if vertex in self._files]
        paths = [self._files[owners[row]] for row in rows]
        map_ = add_resources(map_, vertex_rows=np.array(rows, np.int64), kind="cloud", paths=paths)
        make_mesh(map_, folder, path, self._config)
