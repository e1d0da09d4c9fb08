"""Fixes on missions that only an IMU leads along, in a map."""

from __future__ import annotations

import numpy as np

from mapstream.operators.estimation.starts.first_fixes import inertial_missions
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import IntArray

_KINDS = ("position", "absolute")


def lonely_fixes(map_: Map) -> IntArray:
    """Return the rows of these edges, in the order of time."""
    edges, vertices = map_.edges, map_.vertices
    rows = np.flatnonzero(np.isin(edges.kind, _KINDS) & (edges.vertex_a >= 0))
    missions = vertices.mission[edges.vertex_a[rows]]
    rows = rows[np.isin(missions, list(inertial_missions(map_)))]
    ordered: IntArray = rows[np.argsort(vertices.stamp_ns[edges.vertex_a[rows]], kind="stable")]
    return ordered
