"""The end of a mapping graph: one cloud, put together from the optimised poses, goes to a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import anyio
import numpy as np
from pydantic import Field, PositiveInt

from mapstream.operators.maps.aggregate import AggregateConfig, aggregate_cloud
from mapstream.operators.operator import NoPorts, Operator, offload, report_written, warn
from mapstream.recordings.cloud_files import write_pcd, write_ply
from mapstream.recordings.cloud_store import CloudStore, cloud_key
from mapstream.recordings.maps.build import add_resources
from mapstream.recordings.maps.ids import id_bytes, vertex_id
from mapstream.recordings.maps.model import Map
from mapstream.streams.channel import Receiver
from mapstream.streams.messages.estimates import Submap

Format = Literal["ply", "pcd"]
_WRITERS: dict[Format, Callable[..., None]] = {"ply": write_ply, "pcd": write_pcd}


class CloudSinkConfig(AggregateConfig):
    path: Path = Field(default=Path("cloud.ply"), description="the file, replaced if it exists")
    format: Format | None = Field(default=None, description="by default what the path ends with")
    max_bytes: PositiveInt = Field(
        default=256_000_000, description="of keyframe clouds in memory; all are on disk"
    )

    def chosen_format(self) -> Format:
        """Return the format; PLY where neither the key nor the path says."""
        return self.format or ("pcd" if self.path.suffix.lower() == ".pcd" else "ply")


@dataclass(frozen=True)
class Inputs:
    maps: Receiver[Map]
    submaps: Receiver[Submap]


class CloudSink(Operator[Inputs, NoPorts]):
    """Keep every keyframe's cloud on disk, and put them where the last map's poses say.

    So a loop closure at the end of the run moves the walls that were seen at its beginning.
    """

    placement = "thread"
    spans_epochs = True

    def __init__(self, config: CloudSinkConfig) -> None:
        self.config = config
        self._newest: Map | None = None
        self._files: dict[bytes, str] = {}  # vertex id -> file in the store's folder

    async def run(self, inputs: Inputs, outputs: NoPorts) -> None:  # noqa: ARG002  # a sink
        with CloudStore(max_bytes=self.config.max_bytes) as store:
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._keep_newest, inputs.maps)
                tasks.start_soon(self._keep_clouds, inputs.submaps, store)
            if self._newest is None or not self._files:
                missing = "map" if self._newest is None else "cloud"
                warn(f"no {missing} came, so {self.config.path} was not written")
                return
            await offload(self._write, self._newest, store)
            report_written(self.config.path)

    async def _keep_newest(self, maps: Receiver[Map]) -> None:
        async for map_ in maps:
            self._newest = map_

    async def _keep_clouds(self, submaps: Receiver[Submap], store: CloudStore) -> None:
        async for submap in submaps:
            await offload(self._put, submap, store)

    def _put(self, submap: Submap, store: CloudStore) -> None:
        mission = id_bytes(submap.mission_id)
        for keyframe in submap.keyframes:
            vertex = vertex_id(mission, keyframe.stamp_ns)
            if keyframe.cloud is not None and vertex not in self._files:
                key = cloud_key(submap.mission_id, keyframe.stamp_ns)
                store.put(key, keyframe.cloud)
                self._files[vertex] = store.path_of(key).name

    def _write(self, map_: Map, store: CloudStore) -> None:
        owners = [i.tobytes() for i in map_.vertices.id]
        rows = [row for row, vertex in enumerate(owners) if vertex in self._files]
        paths = [self._files[owners[row]] for row in rows]
        map_ = add_resources(map_, vertex_rows=np.array(rows, np.int64), kind="cloud", paths=paths)
        cloud = aggregate_cloud(map_, store.directory, self.config)
        _WRITERS[self.config.chosen_format()](self.config.path, cloud.points, cloud.intensity)
