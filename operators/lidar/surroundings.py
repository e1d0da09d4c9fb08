"""The clouds of keyframes, and what a stretch of keyframes saw around one of them."""

from __future__ import annotations

from typing import Self

import numpy as np

from mapstream.operators.lidar.trail import Trail
from mapstream.recordings.cloud_store import CloudStore, cloud_key
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.messages.estimates import Submap


class Surroundings:
    """Keyframe clouds on disk, merged on request; memory is bounded by the store."""

    def __init__(self, neighbours: int, max_bytes: int) -> None:
        self._neighbours = neighbours
        self._store = CloudStore(max_bytes=max_bytes)
        self._has_cloud: set[str] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._store.close()

    @property
    def num_bytes(self) -> int:
        """What the clouds in memory take."""
        return self._store.num_bytes

    def keep(self, submap: Submap) -> None:
        """Store the clouds of a submap's keyframes."""
        for keyframe in submap.keyframes:
            key = cloud_key(submap.mission_id, keyframe.stamp_ns)
            if keyframe.cloud is not None and key not in self._has_cloud:
                self._store.put(key, keyframe.cloud)
                self._has_cloud.add(key)

    def at(self, mission_id: str, trail: Trail, index: int) -> FloatArray:
        """Return the points (N, 3) of one keyframe, in its base frame.

        Raises:
            EstimationError: If no cloud came with it.
        """
        key = cloud_key(mission_id, int(trail.stamps_ns[index]))
        if key not in self._has_cloud:
            raise EstimationError(f"no cloud at {trail.stamps_ns[index]} ns")
        return self._store.get(key).points.astype(np.float64)

    def around(self, mission_id: str, trail: Trail, index: int) -> FloatArray:
        """Return the points (N, 3) of a keyframe and its neighbours, in the base frame of the keyframe.

        Raises:
            EstimationError: If no cloud came with the keyframe.
        """
        T_base_mission = trail.pose(index).inverse()
        parts = [self.at(mission_id, trail, index)]
        first = max(0, index - self._neighbours)
        for other in range(first, min(len(trail), index + self._neighbours + 1)):
            key = cloud_key(mission_id, int(trail.stamps_ns[other]))
            if other != index and key in self._has_cloud:
                points = self._store.get(key).points.astype(np.float64)
                parts.append((T_base_mission @ trail.pose(other)) @ points)
        return np.concatenate(parts)
