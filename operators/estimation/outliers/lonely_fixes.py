"""Fixes on missions that only an IMU leads along, in a map: which they are, and which count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapstream.operators.estimation.kinds import make_factors
from mapstream.operators.estimation.noise import NoiseModels
from mapstream.operators.estimation.outliers.consistency import chi2_gate
from mapstream.operators.estimation.starts.first_fixes import inertial_missions
from mapstream.operators.estimation.states import initial_values
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import IntArray

_KINDS = ("position", "absolute")
_TRUE = 0.9999  # of true fixes are nearer than those that are far off


def lonely_fixes(map_: Map) -> dict[bytes, int]:
    """Return the rows of these edges by their id, in the order of time."""
    edges, vertices = map_.edges, map_.vertices
    rows = np.flatnonzero(np.isin(edges.kind, _KINDS) & (edges.vertex_a >= 0))
    missions = vertices.mission[edges.vertex_a[rows]]
    rows = rows[np.isin(missions, list(inertial_missions(map_)))]
    rows = rows[np.argsort(vertices.stamp_ns[edges.vertex_a[rows]], kind="stable")]
    return {edges.id[row].tobytes(): row for row in rows.tolist()}


def far_off(map_: Map, fixes: IntArray) -> list[int]:
    """Return those of these edges that chance does not put so far from where the map has the robot."""
    factors = make_factors(map_, fixes, NoiseModels())
    values = initial_values(map_, {key for f in factors.values() for key in f.keys()})  # noqa: SIM118
    return [r for r, f in factors.items() if 2 * f.error(values) > chi2_gate(f.dim(), _TRUE)]


def false_fixes(map_: Map) -> list[int]:
    """Return the rows of all absolute measurements that are switched off, on missions of any sensors."""
    is_fix = np.isin(map_.edges.kind, _KINDS)
    rows: list[int] = np.flatnonzero(is_fix & (map_.edges.switch < 0.5)).tolist()
    return rows


def switched(map_: Map, rows: Sequence[int], value: float) -> Map:
    """Return the map with this switch on these edges."""
    switch = map_.edges.switch.copy()
    switch[np.array(rows, dtype=np.int64)] = value
    return replace(map_, edges=replace(map_.edges, switch=switch))
