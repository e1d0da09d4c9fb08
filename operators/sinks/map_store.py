"""The end of a mapping graph: maps go to a folder, and the clouds of their keyframes with them."""

from __future__ import annotations

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
    context,
    offload,
    report_written,
)
from mapstream.recordings.cloud_store import CloudStore, cloud_key
from mapstream.recordings.maps.build import add_resources
from mapstream.recordings.maps.combine import merge_maps
from mapstream.recordings.maps.folder import LOCK, FolderLock
from mapstream.recordings.maps.ids import id_bytes, vertex_id
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.store import CLOUDS, MANIFEST, TABLES_FOLDER, load_map, save_locked
from mapstream.streams.channel import Receiver
from mapstream.streams.errors import MapError
from mapstream.streams.messages.estimates import Submap
from mapstream.streams.waiting import Waiters


class MapStoreConfig(OperatorConfig):
    path: Path = Field(default=Path("map"), description="the map's folder")
    on_existing: Literal["error", "replace", "merge"] = Field(
        default="error", description="what to do with a map that is in the folder already"
    )


@dataclass(frozen=True)
class Inputs:
    maps: Receiver[Map]
    submaps: Receiver[Submap] | None = None  # their clouds become part of the map's folder


class MapStore(Operator[Inputs, NoPorts]):
    """Save the newest map whenever one comes, so that a run that is killed leaves the last one.

    The folder is locked for the whole run. Clouds are written as they come and are not kept in memory.
    """

    placement = "thread"
    spans_epochs = True

    def __init__(self, config: MapStoreConfig) -> None:
        self.config = config
        self._base = Map.empty()  # the map that was there, where new ones are merged with it
        self._clouds: dict[bytes, str] = {}  # written so far: vertex id -> file in the folder
        self._seen: set[bytes] = set()  # vertices whose submaps came and whose clouds are written
        self._has_all_clouds = False
        self._news = Waiters()  # of clouds
        self._newest: Map | None = None
        self._num_saved_clouds = 0  # that the saved map could refer to

    async def run(self, inputs: Inputs, outputs: NoPorts) -> None:  # noqa: ARG002  # a sink
        folder = self.config.path
        with FolderLock(folder) as lock:
            self._base = await offload(self._open, folder, context().name)
            async with anyio.create_task_group() as tasks:
                if inputs.submaps is not None:
                    tasks.start_soon(self._write_clouds, inputs.submaps)
                else:
                    self._has_all_clouds = True
                tasks.start_soon(self._save_maps, inputs.maps, lock)
            if self._newest is None:
                raise MapError(f"no map came, so none was saved in {folder}")
            if self._num_saved_clouds < len(self._clouds):
                await offload(self._save, self._newest, lock)
            await offload(self._remove_loose_clouds, folder)

    def _open(self, folder: Path, name: str) -> Map:
        """Return the map to merge new ones with; an empty one where they stand alone.

        Raises:
            MapError: If the folder holds what this run must not touch.
        """
        found = {path.name for path in folder.iterdir()}
        if MANIFEST not in found:
            if foreign := found - {LOCK, CLOUDS, TABLES_FOLDER}:
                raise MapError(
                    f"{folder}: neither a map nor empty, it has {min(foreign)}; choose another folder"
                )
            return Map.empty()
        if self.config.on_existing == "error":
            raise MapError(
                f"{folder}: there is a map already; choose another folder, or replace it"
                f" (--set {name}.on_existing=replace), or merge with it (=merge)"
            )
        return load_map(folder) if self.config.on_existing == "merge" else Map.empty()

    async def _write_clouds(self, submaps: Receiver[Submap]) -> None:
        with CloudStore(self.config.path / CLOUDS, max_bytes=0) as store:
            async for submap in submaps:
                self._clouds |= await offload(self._write, submap, store)
                mission = id_bytes(submap.mission_id)
                self._seen |= {vertex_id(mission, frame.stamp_ns) for frame in submap.keyframes}
                self._news.wake()
        self._has_all_clouds = True
        self._news.wake()

    def _write(self, submap: Submap, store: CloudStore) -> dict[bytes, str]:
        base = self._base
        if submap.mission_id in [base.mission_id(row) for row in range(len(base.missions))]:
            raise MapError(
                f"{self.config.path}: the map has mission {submap.mission_id} already; a recording can"
                " be merged once, set on_existing of the map_store to replace to map it anew"
            )
        mission = id_bytes(submap.mission_id)
        written = {}
        for keyframe in submap.keyframes:
            vertex = vertex_id(mission, keyframe.stamp_ns)
            if keyframe.cloud is not None and vertex not in self._clouds:
                key = cloud_key(submap.mission_id, keyframe.stamp_ns)
                store.put(key, keyframe.cloud)
                written[vertex] = f"{CLOUDS}/{store.path_of(key).name}"
        return written

    async def _save_maps(self, maps: Receiver[Map], lock: FolderLock) -> None:
        async for map_ in maps:
            newest: Map = map_
            while (later := maps.try_receive()) is not None:
                newest = later
            await self._wait_for_clouds(newest)
            self._newest = newest
            await offload(self._save, newest, lock)
            report_written(self.config.path)

    async def _wait_for_clouds(self, map_: Map) -> None:
        """Wait until the newest vertex has its cloud: where clouds cannot be written, the old map stays."""
        newest = [i.tobytes() for i in map_.vertices.id[-1:]]
        while not (self._has_all_clouds or self._seen.issuperset(newest)):
            await self._news.wait()

    def _save(self, map_: Map, lock: FolderLock) -> None:
        clouds = dict(self._clouds)
        owners = [(row, i.tobytes()) for row, i in enumerate(map_.vertices.id)]
        rows = [row for row, vertex in owners if vertex in clouds]
        paths = [clouds[vertex] for _, vertex in owners if vertex in clouds]
        map_ = add_resources(map_, vertex_rows=np.array(rows, np.int64), kind="cloud", paths=paths)
        save_locked(merge_maps([self._base, map_]) if len(self._base.missions) else map_, lock)
        self._num_saved_clouds = len(clouds)

    def _remove_loose_clouds(self, folder: Path) -> None:
        """Remove clouds that no vertex of the saved map has, as those of a map that was replaced."""
        resources = load_map(folder, tables=["resources"]).resources
        kept = {folder / path for path in resources.path[resources.topic == ""]}
        for file in (folder / CLOUDS).glob("*"):
            if file not in kept:
                file.unlink()
