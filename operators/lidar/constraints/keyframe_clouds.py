"""The clouds of a stored map's keyframes, with those of their neighbours; memory is bounded."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

import numpy as np

from mapstream.recordings.cloud_store import read_cloud
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import Float32Array, FloatArray, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import invert


class KeyframeClouds:
    """Reads clouds when they are asked for, and keeps those used last.

    Args:
        map_: The map; its poses say how neighbours lie to each other.
        folder: Where its clouds are; None for a map that has none.
        max_bytes: What the clouds in memory may take.

    Raises:
        MapError: If the map has clouds and no folder is given.
    """

    def __init__(self, map_: Map, folder: Path | None, max_bytes: int) -> None:
        resources = map_.resources
        rows = np.flatnonzero((resources.kind == "cloud") & (resources.topic == ""))
        if len(rows) and folder is None:
            raise MapError("the map has clouds, and nobody said in which folder they are")
        self._map, self._folder, self._max_bytes = map_, folder or Path(), max_bytes
        self._path = {int(resources.vertex[row]): str(resources.path[row]) for row in rows}
        self._recent: OrderedDict[int, Float32Array] = OrderedDict()  # least recently used first
        self.num_bytes = 0  # of the clouds in memory
        self._place: dict[int, tuple[int, IntArray]] = {}  # vertex -> its number in a mission
        owners = np.fromiter(self._path, np.int64)
        for mission in np.unique(map_.vertices.mission[owners]).tolist():
            rows = map_.vertices_of(mission)
            rows = rows[np.isin(rows, owners)]
            self._place |= {vertex: (n, rows) for n, vertex in enumerate(rows.tolist())}

    @property
    def vertices(self) -> IntArray:
        """Rows of the vertices that have a cloud, increasing."""
        return np.array(sorted(self._path), dtype=np.int64)

    def at(self, vertex: int) -> Float32Array:
        """Return the points (N, 3) of one keyframe, in its base frame.

        Raises:
            MapError: If it has no cloud, or its file is not there or damaged.
        """
        known = self._recent.pop(vertex, None)
        if known is None:
            if vertex not in self._path:
                raise MapError(f"the vertex in row {vertex} has no cloud")
            known = read_cloud(self._folder / self._path[vertex]).points
            self.num_bytes += known.nbytes
        self._recent[vertex] = known
        while self.num_bytes > self._max_bytes and len(self._recent) > 1:
            self.num_bytes -= self._recent.popitem(last=False)[1].nbytes
        return known

    def around(self, vertex: int, before: int, after: int) -> FloatArray:
        """Return the points (N, 3) of a keyframe and its neighbours in the mission, in its base frame.

        Args:
            vertex: Its row.
            before: So many neighbours before it.
            after: So many after it.
        """
        place, rows = self._place[vertex]
        near = rows[max(place - before, 0) : place + after + 1]
        poses = self._map.vertices.T_mission_base
        steps = invert(poses[vertex]) @ poses[near]
        parts = [
            self.at(row).astype(np.float64) @ T[:3, :3].T + T[:3, 3]
            for row, T in zip(near.tolist(), steps, strict=True)
        ]
        return np.concatenate(parts)

    def of_pair(self, a: int, b: int, neighbours: int) -> tuple[FloatArray, FloatArray]:
        """Return the surroundings of two keyframes, which share no cloud, with as many neighbours on all sides.

        A cloud in both would fit itself, wherever the two really lie. With neighbours on one side alone, an error
        that the poses have at each step would come back doubled, and grow with each round.
        """
        (place_a, rows_a), (place_b, rows_b) = self._place[a], self._place[b]
        if rows_a is rows_b:
            neighbours = min(neighbours, max(0, (abs(place_b - place_a) - 1) // 2))
        return self.around(a, neighbours, neighbours), self.around(b, neighbours, neighbours)
