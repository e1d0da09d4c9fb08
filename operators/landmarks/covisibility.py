"""How many points consecutive vertices see in common."""

from __future__ import annotations

import numpy as np

from mapstream.operators.landmarks.sensors import numbered
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import IntArray


def common_with_next(map_: Map, vertices: IntArray) -> IntArray:
    """Return how many points each of these vertices sees in common with the next (N - 1,).

    A point is a landmark, or a track that has none yet.

    Args:
        map_: The map.
        vertices: Rows (N,) in the order in which they follow each other.
    """
    points, position = points_of(map_, vertices)
    pairs = np.unique(np.stack([points, position]), axis=1)
    follows = (np.diff(pairs[0]) == 0) & (np.diff(pairs[1]) == 1)
    return np.bincount(pairs[1, :-1][follows], minlength=max(len(vertices) - 1, 0))


def points_of(map_: Map, vertices: IntArray) -> tuple[IntArray, IntArray]:
    """Return the points that were seen from vertices, by number (M,), and the place (M,) of the vertex in the list."""
    seen = map_.observations
    place = np.full(len(map_.vertices), -1)
    place[vertices] = np.arange(len(vertices))
    rows = np.flatnonzero((place[seen.vertex] >= 0) & ((seen.landmark >= 0) | (seen.track >= 0)))
    kinds, _ = numbered(seen.kind[rows])
    mission = map_.vertices.mission[seen.vertex[rows]]
    has_landmark = seen.landmark[rows] >= 0
    keys = np.stack([
        np.where(has_landmark, -1, mission),
        np.where(has_landmark, -1, kinds),
        np.where(has_landmark, seen.landmark[rows], seen.track[rows]),
    ])  # fmt: skip
    _, points = np.unique(keys, axis=1, return_inverse=True)
    return points.ravel().astype(np.int64), place[seen.vertex[rows]]
