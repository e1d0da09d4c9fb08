"""Which keyframes are registered to each other: those in a row, and those that lie near each other.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-D ("constraints between consecutive and
close-by point clouds, within and between missions"), with the limits of its server.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.geometry import invert, so3_log

Relation = Literal["consecutive", "within", "between"]


class CandidatesConfig(OperatorConfig):
    """Which keyframes are candidates."""

    consecutive: bool = True
    """Keyframes that follow on each other."""
    max_gap_s: PositiveFloat = 20.0
    """Time between two in a row."""
    max_step_m: PositiveFloat = 5.0
    """Distance between two in a row."""
    max_turn_deg: PositiveFloat = 180.0
    """Turn between two in a row."""
    within: bool = True
    """Keyframes of one mission that lie near each other."""
    between: bool = True
    """Keyframes of different missions, where the place of both is known."""
    max_distance_m: PositiveFloat = 2.0
    """Between two that lie near each other."""
    min_path_m: NonNegativeFloat = 2.0
    """So much way lies between two of one mission that are near each other."""
    closest: PositiveInt = 3
    """Of the keyframes near one, so many are candidates: of its mission, and again of others."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two vertices; b is the later one, or of the later mission."""

    vertex_a: int
    vertex_b: int
    relation: Relation


def candidates(map_: Map, vertices: IntArray, config: CandidatesConfig) -> list[Pair]:
    """Return the pairs of these vertices that are worth registering, each once, in the order of b.

    Args:
        map_: The map; distances are by its poses.
        vertices: Rows of vertices that have clouds.
        config: Which are candidates.
    """
    ordered = _in_order(map_, vertices)
    found = [*_consecutive(map_, ordered, config), *_near(map_, ordered, config)]
    place = {vertex: n for n, vertex in enumerate(ordered.tolist())}
    unique: dict[tuple[int, int], Pair] = {}
    for pair in found:
        unique.setdefault((pair.vertex_a, pair.vertex_b), pair)
    return sorted(unique.values(), key=lambda p: (place[p.vertex_b], place[p.vertex_a]))


def _in_order(map_: Map, vertices: IntArray) -> IntArray:
    """Return the vertices by mission and stamp."""
    keys = (map_.vertices.stamp_ns[vertices], map_.vertices.mission[vertices])
    return vertices[np.lexsort(keys)]


def _consecutive(map_: Map, ordered: IntArray, config: CandidatesConfig) -> Iterable[Pair]:
    if not config.consecutive:
        return []
    a, b = ordered[:-1], ordered[1:]
    vertices = map_.vertices
    step = invert(vertices.T_mission_base[a]) @ vertices.T_mission_base[b]
    is_near: BoolArray = vertices.mission[a] == vertices.mission[b]
    is_near &= vertices.stamp_ns[b] - vertices.stamp_ns[a] <= config.max_gap_s * 1e9
    is_near &= np.linalg.norm(step[:, :3, 3], axis=1) <= config.max_step_m
    is_near &= _turned_deg(step) <= config.max_turn_deg
    return _pairs(a[is_near], b[is_near], "consecutive")


def _turned_deg(step: FloatArray) -> FloatArray:
    turned: FloatArray = np.rad2deg(np.linalg.norm(so3_log(step[:, :3, :3]), axis=1))
    return turned


def _near(map_: Map, ordered: IntArray, config: CandidatesConfig) -> list[Pair]:
    from scipy.spatial import cKDTree  # noqa: PLC0415  # scipy takes its time

    if len(ordered) < 2 or not (config.within or config.between):
        return []
    positions = map_.T_map_base(ordered)[:, :3, 3]
    mission = map_.vertices.mission[ordered]
    near = cKDTree(positions).query_pairs(config.max_distance_m, output_type="ndarray")
    a, b = near.min(axis=1), near.max(axis=1)
    distance_m = np.linalg.norm(positions[a] - positions[b], axis=1)
    by_distance = np.lexsort((a, distance_m, b))
    a, b = a[by_distance], b[by_distance]
    is_same = mission[a] == mission[b]
    way_m = _way_m(map_.vertices.T_mission_base[ordered][:, :3, 3], mission)
    may_be = is_same & (way_m[b] - way_m[a] >= config.min_path_m) & (b - a > 1) & config.within
    is_known = map_.missions.is_base_frame_known[mission]
    may_be |= ~is_same & is_known[a] & is_known[b] & config.between
    pairs: list[Pair] = []
    taken: Counter[tuple[int, bool]] = Counter()
    for row_a, row_b, same in zip(a[may_be], b[may_be], is_same[may_be], strict=True):
        if taken[int(row_b), bool(same)] < config.closest:
            taken[int(row_b), bool(same)] += 1
            relation: Relation = "within" if same else "between"
            pairs += _pairs(ordered[[row_a]], ordered[[row_b]], relation)
    return pairs


def _way_m(positions: FloatArray, mission: IntArray) -> FloatArray:
    """Return how far each (N,) lies along the way of its mission, from any origin."""
    steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    steps_m[mission[1:] != mission[:-1]] = 0.0
    way_m: FloatArray = np.concatenate([[0.0], np.cumsum(steps_m)])
    return way_m


def _pairs(a: IntArray, b: IntArray, relation: Relation) -> list[Pair]:
    return [
        Pair(vertex_a=int(row_a), vertex_b=int(row_b), relation=relation)
        for row_a, row_b in zip(a, b, strict=True)
    ]
