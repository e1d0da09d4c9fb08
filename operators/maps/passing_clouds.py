"""The clouds of keyframes while a graph runs: kept on disk for the tools that work on the map before it is stored."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import anyio
import numpy as np

from mapstream.operators.operator import offload
from mapstream.recordings.cloud_store import CloudStore, cloud_key
from mapstream.recordings.maps.build import add_resources
from mapstream.recordings.maps.ids import id_bytes, vertex_id
from mapstream.recordings.maps.model import Map
from mapstream.streams.channel import Receiver
from mapstream.streams.messages.estimates import Submap
from mapstream.streams.waiting import Waiters


class PassingClouds:
    """A temporary folder with the clouds of all submaps so far."""

    def __init__(self, max_bytes: int = 0) -> None:
        """Open the folder; so many bytes of clouds stay in memory too."""
        self._store = CloudStore(max_bytes=max_bytes)
        self._files: dict[bytes, str] = {}  # by vertex id
        self._seen: set[bytes] = set()  # vertices whose submaps came
        self._has_ended = False
        self._news = Waiters()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._store.close()

    def __len__(self) -> int:
        return len(self._files)

    @property
    def folder(self) -> Path:
        return self._store.directory

    def keep(self, submap: Submap) -> None:
        """Write the clouds of a submap's keyframes."""
        mission = id_bytes(submap.mission_id)
        for keyframe in submap.keyframes:
            vertex = vertex_id(mission, keyframe.stamp_ns)
            if keyframe.cloud is not None and vertex not in self._files:
                key = cloud_key(submap.mission_id, keyframe.stamp_ns)
                self._store.put(key, keyframe.cloud)
                self._files[vertex] = self._store.path_of(key).name
            self._seen.add(vertex)

    def tell(self) -> None:
        """Wake who waits for clouds."""
        self._news.wake()

    def end(self) -> None:
        """No more submaps come."""
        self._has_ended = True
        self._news.wake()

    async def wait_for(self, map_: Map) -> None:
        """Wait until the submaps came that the map was made of."""
        wanted = {row.tobytes() for row in map_.vertices.id}
        while not (self._has_ended or self._seen.issuperset(wanted)):
            await self._news.wait()

    def put_into(self, map_: Map) -> Map:
        """Return the map with the clouds of its vertices as resources."""
        owners = [(row, vertex.tobytes()) for row, vertex in enumerate(map_.vertices.id)]
        rows = [row for row, vertex in owners if vertex in self._files]
        paths = [self._files[vertex] for _, vertex in owners if vertex in self._files]
        return add_resources(map_, vertex_rows=np.array(rows, np.int64), kind="cloud", paths=paths)

    def taken_out(self, map_: Map) -> Map:
        """Return the map without what `put_into` added: the store of the map keeps clouds itself."""
        own = np.isin(map_.resources.path, sorted(self._files.values()))
        return map_.select(resources=~(own & (map_.resources.kind == "cloud")))

    async def gather(self, maps: Receiver[Map], submaps: Receiver[Submap] | None) -> Map | None:
        """Keep the clouds of submaps to the end of the run; return the newest map, or None if none came."""
        newest: Map | None = None

        async def keep_clouds(submaps: Receiver[Submap]) -> None:
            async for submap in submaps:
                await offload(self.keep, submap)

        async with anyio.create_task_group() as tasks:
            if submaps is not None:
                tasks.start_soon(keep_clouds, submaps)
            async for map_ in maps:
                newest = map_
        return newest
