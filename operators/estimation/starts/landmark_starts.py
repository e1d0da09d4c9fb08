"""Where landmarks begin: at the mean of all that was seen of them.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-A: 3D observations are averaged.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapstream.operators.estimation.factors.landmarks import shape_of
from mapstream.operators.landmarks.views import views_of
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import invert

_EDGE_KINDS = ("landmark",)


def averaged_landmarks(map_: Map) -> Map:
    """Return the map with each 3D point at the mean of its observations in the map frame, each alike.

    Observations are edges of kind `landmark` and rows of the table `observations` with a point.
    Points that nothing saw, and landmarks of other shapes, stay.
    """
    is_point = np.array([shape_of(kind) == "point" for kind in map_.landmarks.kind], dtype=bool)
    sums, counts = np.zeros((len(is_point), 3)), np.zeros(len(is_point), np.int64)
    for landmarks, points in (_of_edges(map_), _of_observations(map_)):
        np.add.at(sums, landmarks, points)
        np.add.at(counts, landmarks, 1)
    rows = np.flatnonzero(is_point & (counts > 0))
    if not len(rows):
        return map_
    p_map = np.column_stack([sums[rows] / counts[rows, None], np.ones(len(rows))])
    T_base_map = invert(map_.T_map_base(map_.landmarks.vertex[rows]))
    p_base = map_.landmarks.p_base.copy()
    p_base[rows] = np.einsum("nij,nj->ni", T_base_map, p_map)[:, :3]
    return replace(map_, landmarks=replace(map_.landmarks, p_base=p_base))


def _of_edges(map_: Map) -> tuple[IntArray, FloatArray]:
    edges = map_.edges
    is_seen = np.isin(edges.kind, _EDGE_KINDS) & (edges.landmark_a >= 0) & (edges.vertex_a >= 0)
    rows = np.flatnonzero(is_seen)
    seen = map_.T_map_base(edges.vertex_a[rows]) @ edges.T_a_b[rows]
    return edges.landmark_a[rows], seen[:, :3, 3]


def _of_observations(map_: Map) -> tuple[IntArray, FloatArray]:
    seen = map_.observations
    rows = np.flatnonzero(np.isfinite(seen.p_sensor).all(axis=1) & (seen.landmark >= 0))
    return seen.landmark[rows], views_of(map_, rows).points
