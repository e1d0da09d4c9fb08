"""How far the poses of a map are from what its edges measured."""

from __future__ import annotations

import numpy as np

from mapstream.operators.estimation.outliers.consistency import mahalanobis
from mapstream.recordings.maps.edge_kinds import RELATIVE_KINDS
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import invert, se3_log


def relative_edges(map_: Map, kinds: tuple[str, ...] = RELATIVE_KINDS) -> IntArray:
    """Return the rows of edges of these kinds that measured a transform between two vertices."""
    edges = map_.edges
    has_ends = (edges.vertex_a >= 0) & (edges.vertex_b >= 0)
    return np.flatnonzero(has_ends & np.isin(edges.kind, kinds))


def residuals(map_: Map, rows: IntArray) -> FloatArray:
    """Return log(T_a_b^-1 T_a^-1 T_b) (N, 6) of edges between two vertices: what is left over."""
    edges = map_.edges
    T_a = map_.T_map_base(edges.vertex_a[rows])
    T_b = map_.T_map_base(edges.vertex_b[rows])
    return se3_log(invert(edges.T_a_b[rows]) @ invert(T_a) @ T_b)


def chi2(map_: Map, rows: IntArray) -> FloatArray:
    """Return squared residuals (N,) in units of their covariances; what was not measured counts nothing."""
    return mahalanobis(residuals(map_, rows), map_.edges.covariance[rows])


def num_measured(map_: Map, rows: IntArray) -> IntArray:
    """Return how many of the six directions each edge measured (N,)."""
    variances = np.diagonal(map_.edges.covariance[rows], axis1=1, axis2=2)
    counts: IntArray = np.isfinite(variances).sum(axis=1)
    return counts
