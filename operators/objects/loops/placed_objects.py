"""The objects of a map as loop closure sees them: what they are, where, how surely, and when they were seen."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from mapstream.recordings.maps.columns import TextArray
from mapstream.recordings.maps.features import descriptors_of
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import Float32Array, FloatArray, IntArray

KIND = "object"


@dataclass(frozen=True, slots=True, eq=False)
class PlacedObjects:
    """Landmarks (N,) of objects that were seen, in the order of their rows."""

    landmark: IntArray  # rows
    mission: IntArray
    label: TextArray
    text: TextArray  # an identity; "": it has none
    positions: FloatArray  # (N, 3) in the map frame [m]
    covariances: (
        FloatArray  # (N, 3, 3) of where their middles are, whichever way they are looked at
    )
    first_ns: IntArray  # when they were first seen
    last_ns: IntArray
    first_way_m: FloatArray  # how far the robot had come in its mission by then
    last_way_m: FloatArray
    vertices: tuple[IntArray, ...]  # from where they were seen, in the order of time
    descriptors: tuple[Float32Array, ...]  # those that represent each (K, D); (0, D): it has none

    def __len__(self) -> int:
        return len(self.landmark)


def placed_objects(map_: Map, sigma_m: float) -> PlacedObjects:
    """Return the objects of a map whose places are known.

    Args:
        map_: The map.
        sigma_m: What no object's place is surer than [m].
    """
    seen = map_.observations
    is_object = np.append(map_.landmarks.kind == KIND, [False])  # the last is that of no landmark
    rows = np.flatnonzero(is_object[seen.landmark])
    stamps_ns = map_.vertices.stamp_ns[seen.vertex[rows]]
    rows = rows[np.lexsort((stamps_ns, seen.landmark[rows]))]
    landmark, start = np.unique(seen.landmark[rows], return_index=True)
    parts = np.split(rows, start[1:]) if len(rows) else []
    vertex = map_.landmarks.vertex[landmark]
    poses = map_.T_map_landmark(landmark)
    R = map_.T_map_base(vertex)[:, :3, :3]
    covariances = R @ np.nan_to_num(map_.landmarks.covariance[landmark]) @ np.swapaxes(R, 1, 2)
    payloads = [json.loads(data) if data else {} for data in map_.landmarks.payload[landmark]]
    first, last = (np.array([seen.vertex[part[at]] for part in parts], np.int64) for at in (0, -1))
    way_m = ways_m(map_)
    return PlacedObjects(
        landmark=landmark,
        mission=map_.vertices.mission[vertex],
        label=map_.landmarks.label[landmark],
        text=np.array([p.get("text", "") for p in payloads], object),
        positions=poses[:, :3, 3],
        covariances=covariances + sigma_m**2 * np.eye(3),
        first_ns=map_.vertices.stamp_ns[first],
        last_ns=map_.vertices.stamp_ns[last],
        first_way_m=way_m[first],
        last_way_m=way_m[last],
        vertices=tuple(seen.vertex[part] for part in parts),
        descriptors=tuple(_descriptors(map_, part) for part in parts),
    )


def weights(objects: PlacedObjects, a: IntArray, b: IntArray) -> FloatArray:
    """Return what pairs of objects (N,) are worth [1/m^2]: those whose places are sure most."""
    variance = np.trace(objects.covariances[a] + objects.covariances[b], axis1=1, axis2=2)
    worth: FloatArray = 3.0 / variance
    return worth


def ways_m(map_: Map) -> FloatArray:
    """Return how far the robot has come at each vertex (V,) since its mission began [m]."""
    way_m = np.zeros(len(map_.vertices))
    for mission in range(len(map_.missions)):
        rows = map_.vertices_of(mission)
        at = map_.vertices.T_mission_base[rows, :3, 3]
        way_m[rows[1:]] = np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1))
    return way_m


def _descriptors(map_: Map, rows: IntArray) -> Float32Array:
    """Return the descriptors (K, D) that stand for an object; all of them where none were chosen."""
    described = rows[map_.observations.feature_set[rows] >= 0]
    if not len(described):
        return np.empty((0, 0), np.float32)
    table = map_.detections
    chosen = np.intersect1d(described, table.observation[table.is_representative])
    found: Float32Array = descriptors_of(map_, chosen if len(chosen) else described).astype(
        np.float32
    )
    return found[found.any(axis=1)]  # zeros: none
