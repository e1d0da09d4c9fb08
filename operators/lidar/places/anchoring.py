"""Missions anchored by loops to others, where enough loops agree on where they lie to each other."""

from __future__ import annotations

import numpy as np
from pydantic import PositiveFloat, PositiveInt

from mapstream.operators.operator import OperatorConfig
from mapstream.operators.places.agreement import agreement, largest_agreement, mean_pose
from mapstream.recordings.maps.build import anchored
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.geometry import SE3, invert

ANCHORED = "anchored"


class AgreementConfig(OperatorConfig):
    """When loops between two missions are believed."""

    min_agreeing: PositiveInt = 3
    """So many loops between two missions agree with each other, or none of them counts."""
    agree_m: PositiveFloat = 2.0
    """Between two that agree: odometry drifts from one to the other."""
    agree_rad: PositiveFloat = 0.174
    """The same of the turn."""


def without_lone_edges(map_: Map, source: str, config: AgreementConfig) -> tuple[Map, int]:
    """Return the map without edges between missions that too few others agree with, and how many went.

    Args:
        map_: The map.
        source: Of the edges that are looked at.
        config: When they agree.
    """
    goes: BoolArray = np.zeros(len(map_.edges), bool)
    for rows in _by_missions(map_, source):
        poses, points = _claims(map_, rows)
        agree = agreement(poses, config.agree_rad, config.agree_m, points)
        goes[rows] = agree.sum(axis=1) < config.min_agreeing
    return map_.select(edges=~goes), int(goes.sum())


def anchor_by_edges(map_: Map, source: str, config: AgreementConfig) -> tuple[Map, dict[str, str]]:
    """Return the map with missions anchored to known ones, and what became of each that was unknown.

    Args:
        map_: The map.
        source: Of the edges that say where missions lie.
        config: When they agree.
    """
    verdicts: dict[str, str] = {}
    pairs = _by_missions(map_, source)
    for _ in range(len(map_.missions)):  # one that is anchored may carry others
        before = map_
        for rows in pairs:
            map_ = _anchored(map_, rows, config, verdicts)
        if map_ is before:
            break
    for mission in np.flatnonzero(~map_.missions.is_base_frame_known).tolist():
        verdicts.setdefault(map_.mission_id(mission), "no loop leads to a mission that is anchored")
    return map_, verdicts


def _anchored(map_: Map, rows: IntArray, config: AgreementConfig, verdicts: dict[str, str]) -> Map:
    """Return the map with one mission of a pair anchored to the other, if that one alone is known."""
    a, b = _missions(map_, rows[:1])[0]
    is_known = map_.missions.is_base_frame_known
    if is_known[a] == is_known[b]:
        return map_
    T_a_b, points = _claims(map_, rows)
    best = largest_agreement(T_a_b, config.agree_rad, config.agree_m, points)
    num = int(best.sum())
    unknown = b if is_known[a] else a
    if num < config.min_agreeing:
        verdicts[map_.mission_id(unknown)] = f"{num} loops agree, fewer than {config.min_agreeing}"
        return map_
    mean = SE3(mean_pose(T_a_b[best]))
    T_map_a, T_map_b = (map_.missions.T_map_mission_of(row) for row in (a, b))
    verdicts[map_.mission_id(unknown)] = ANCHORED
    T_map_unknown = T_map_a @ mean if unknown == b else T_map_b @ mean.inverse()
    return anchored(map_, unknown, T_map_unknown)


def same_mission(map_: Map, rows: IntArray) -> BoolArray:
    """Return which edges (N,) have both ends in one mission."""
    a, b = _missions(map_, rows).T
    is_same: BoolArray = a == b
    return is_same


def _missions(map_: Map, rows: IntArray) -> IntArray:
    """Return the missions at the ends of edges (N, 2)."""
    edges, mission = map_.edges, map_.vertices.mission
    ends: IntArray = np.stack(
        [mission[edges.vertex_a[rows]], mission[edges.vertex_b[rows]]], axis=1
    )
    return ends


def _by_missions(map_: Map, source: str) -> list[IntArray]:
    """Return the edges of a source between missions, those of each two missions together."""
    rows = np.flatnonzero(map_.edges.source == source)
    ends = _missions(map_, rows)
    pairs = np.unique(ends[ends[:, 0] != ends[:, 1]], axis=0)
    return [rows[(ends == pair).all(axis=1)] for pair in pairs]


def _claims(map_: Map, rows: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return where edges say that the frame of b's mission lies in that of a's (N, 4, 4), and b's positions (N, 3)."""
    poses, edges = map_.vertices.T_mission_base, map_.edges
    T_b = poses[edges.vertex_b[rows]]
    claims: FloatArray = poses[edges.vertex_a[rows]] @ edges.T_a_b[rows] @ invert(T_b)
    return claims, T_b[:, :3, 3]
