"""How the outline of a plane grows in the map, as more of the plane is seen.

Source: Trevor, Rogers, Christensen: Planar surface SLAM with 3D and 2D sensors, ICRA 2012.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapstream.recordings.maps.hulls import convex_hull, hull_of, hull_payload, moved_hull
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.object_payload import object_payload
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import invert


def with_hulls_of(map_: Map, edges: IntArray) -> Map:
    """Return the map with the outlines of planes grown by what these edges (rows) saw of them."""
    landmarks = map_.edges.landmark_a[edges]
    is_plane = (landmarks >= 0) & (map_.edges.vertex_a[edges] >= 0)
    is_plane[is_plane] = map_.landmarks.kind[landmarks[is_plane]] == "plane"
    edges, landmarks = edges[is_plane], landmarks[is_plane]
    if not len(edges):
        return map_
    T_map_seen = map_.T_map_base(map_.edges.vertex_a[edges]) @ map_.edges.T_a_b[edges]
    T_landmark_seen = invert(map_.T_map_landmark(landmarks)) @ T_map_seen
    seen: dict[int, list[FloatArray]] = {}
    for edge, landmark, T in zip(edges.tolist(), landmarks.tolist(), T_landmark_seen, strict=True):
        hull = hull_of(map_.edges.payload[edge])
        if len(hull):
            seen.setdefault(landmark, []).append(moved_hull(T, hull))
    payload = map_.landmarks.payload.copy()
    for landmark, hulls in seen.items():
        grown = convex_hull(np.concatenate([hull_of(payload[landmark]), *hulls]))
        payload[landmark] = hull_payload(grown, object_payload(map_.landmarks, landmark))
    return replace(map_, landmarks=replace(map_.landmarks, payload=payload))
