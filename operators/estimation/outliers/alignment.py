"""Missions put into one frame by the loops between them alone, most of which may be false.

Two loops between the same two missions close a cycle through both odometries. For each pair of missions the
largest set of loops that agree pairwise is sought (PCM, Mangelson et al., ICRA 2018); a tree over the missions
takes the pairs with the largest sets first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PositiveInt

from mapstream.operators.estimation.outliers.consistency import (
    OdometryChain,
    chi2_gate,
    in_frame,
    mahalanobis,
    odometry_chain,
)
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.geometry import invert, se3_log

_SEEDS = 20  # loops with the most agreeing others, from each of which a set is grown
_WIDENINGS = (1.0, 4.0, 16.0)  # of the gate, for graphs whose covariances promise too much


class AlignConfig(BaseModel):
    """How missions are aligned by the loops between them."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    min_loops: PositiveInt = 3
    """Loops that must agree with each other before two missions are put together."""
    gate_probability: float = Field(default=0.99, gt=0, lt=1)
    """Two true loops close a cycle below the chi2 that they stay below this often."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairReport:
    """What the loops between two missions say."""

    mission_a: str
    mission_b: str
    num_loops: int
    num_agreeing: int  # in the largest set that agrees pairwise
    is_used: bool  # whether it placed a mission


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignmentReport:
    """Which missions were placed, and by what."""

    pairs: list[PairReport]
    placed: list[str]  # missions whose base frame is known now, and was not before
    left: list[str]  # missions that no loops tie to the others well enough


def align_missions(map_: Map, config: AlignConfig | None = None) -> tuple[Map, AlignmentReport]:
    """Return the map with `T_map_mission` of the missions that loops tie to known ones.

    Missions whose base frame is known stay. Without one, the first mission is where its frame says.
    """
    config = config or AlignConfig()
    pairs, gate = _pairs(map_), float(chi2_gate(6, config.gate_probability))
    is_known = map_.missions.is_base_frame_known.copy()
    is_known[:1] |= not is_known.any()
    frames, used = map_.missions.T_map_mission.copy(), dict[int, _AgreeingLoops]()
    sets: list[_AgreeingLoops] = []
    for widening in _WIDENINGS:
        sets = [_largest_set(pair, widening * gate) for pair in pairs]
        while (number := _strongest(sets, is_known, config.min_loops)) is not None:
            each = used[number] = sets[number]
            if is_known[each.a]:
                frames[each.b] = frames[each.a] @ each.T_a_b
            else:
                frames[each.a] = frames[each.b] @ invert(each.T_a_b)
            is_known[[each.a, each.b]] = True
        if is_known.all():
            break
    reports = [
        _pair_report(map_, used.get(number, each), number in used)
        for number, each in enumerate(sets)
    ]
    before = map_.missions.is_base_frame_known
    report = AlignmentReport(
        pairs=reports,
        placed=[map_.mission_id(row) for row in np.flatnonzero(is_known & ~before).tolist()],
        left=[map_.mission_id(row) for row in np.flatnonzero(~is_known).tolist()],
    )
    missions = replace(map_.missions, T_map_mission=frames, is_base_frame_known=is_known)
    return replace(map_, missions=missions), report


def _pair_report(map_: Map, each: _AgreeingLoops, is_used: bool) -> PairReport:  # noqa: FBT001
    return PairReport(
        mission_a=map_.mission_id(each.a),
        mission_b=map_.mission_id(each.b),
        num_loops=each.num_loops,
        num_agreeing=len(each.rows),
        is_used=is_used,
    )


@dataclass(frozen=True, slots=True)
class _AgreeingLoops:
    """The largest set of loops between two missions that agree, and the transform they mean."""

    a: int
    b: int
    num_loops: int
    rows: IntArray
    T_a_b: FloatArray  # (4, 4) between the missions' frames


def _strongest(sets: list[_AgreeingLoops], is_known: BoolArray, least: int) -> int | None:
    """Return the set with the most loops from a known mission to an unknown one, or None if there is none."""
    best, most = None, least - 1
    for number, each in enumerate(sets):
        if is_known[each.a] != is_known[each.b] and len(each.rows) > most:
            best, most = number, len(each.rows)
    return best


@dataclass(frozen=True, slots=True)
class _Pair:
    """Two missions, and the loops between them."""

    a: int
    b: int
    rows: IntArray
    T_a_b: FloatArray  # (N, 4, 4) between the missions' frames, as each loop means it
    chi2: FloatArray  # (N, N) of the cycle of every two; infinite where odometry does not link them


def _pairs(map_: Map) -> list[_Pair]:
    edges, mission = map_.edges, map_.vertices.mission
    chain = odometry_chain(map_)
    rows = np.flatnonzero((edges.vertex_a >= 0) & (edges.vertex_b >= 0))
    ends = np.sort(np.column_stack([mission[edges.vertex_a[rows]], mission[edges.vertex_b[rows]]]))
    pairs = []
    for a, b in combinations(range(len(map_.missions)), 2):
        between = rows[(ends == (a, b)).all(axis=1)]
        if len(between):
            pairs.append(_pair(map_, a, b, between, chain))
    return pairs


def _pair(map_: Map, a: int, b: int, rows: IntArray, chain: OdometryChain) -> _Pair:
    loops, T_mission = _between(map_, a, rows), map_.vertices.T_mission_base
    chi2 = np.array([_cycles(loops, each, chain) for each in range(len(rows))])
    runs = np.column_stack([chain.run[loops.a], chain.run[loops.b]])
    is_linked = (runs[:, None] == runs[None]).all(axis=2)
    T_a_b = T_mission[loops.a] @ loops.T_a_b @ invert(T_mission[loops.b])
    return _Pair(a, b, rows, T_a_b, np.where(is_linked, np.maximum(chi2, chi2.T), np.inf))


def _largest_set(pair: _Pair, gate: float) -> _AgreeingLoops:
    """Return the loops between two missions that agree pairwise; the most central one means the transform."""
    members = _clique(pair.chi2 < gate)
    middle = members[np.argmin(pair.chi2[np.ix_(members, members)].sum(axis=1))]
    return _AgreeingLoops(
        pair.a, pair.b, len(pair.rows), pair.rows[np.sort(members)], pair.T_a_b[middle]
    )


@dataclass(frozen=True, slots=True)
class _Loops:
    """Loops from vertices of one mission to vertices of another."""

    a: IntArray
    b: IntArray
    T_a_b: FloatArray  # (N, 4, 4)
    covariance: FloatArray  # (N, 6, 6) in the frame of b


def _between(map_: Map, mission_a: int, rows: IntArray) -> _Loops:
    """Return edges as loops that begin in this mission, whichever way they were measured."""
    edges = map_.edges
    a, b = edges.vertex_a[rows], edges.vertex_b[rows]
    T, covariance = edges.T_a_b[rows], edges.covariance[rows]
    is_turned = map_.vertices.mission[a] != mission_a
    turned = is_turned[:, None, None]
    return _Loops(
        np.where(is_turned, b, a),
        np.where(is_turned, a, b),
        np.where(turned, invert(T), T),
        np.where(turned, in_frame(covariance, T), covariance),
    )


def _cycles(loops: _Loops, one: int, chain: OdometryChain) -> FloatArray:
    """Return the chi2 (N,) of the cycles that one loop closes with every other, through both odometries."""
    a, b, poses = loops.a, loops.b, chain.poses
    to_b = invert(poses[b[one]])
    T_by_each = poses[a] @ loops.T_a_b @ invert(poses[b])  # between the runs
    left = se3_log(to_b @ invert(T_by_each[one]) @ T_by_each @ poses[b[one]])
    spread_a = in_frame(chain.spread(a[one], a), invert(poses[a[one]] @ loops.T_a_b[one]))
    spread_b = in_frame(chain.spread(b[one], b), to_b)
    others = in_frame(loops.covariance, to_b @ poses[b])
    return mahalanobis(left, loops.covariance[one] + others + spread_a + spread_b)


def _clique(agree: BoolArray) -> IntArray:
    """Return a large set (M,) of loops that all agree with each other, grown from those with most agreement."""
    best: list[int] = []
    degree = agree.sum(axis=1)
    for seed in np.argsort(-degree, kind="stable")[:_SEEDS].tolist():
        members, candidates = [seed], agree[seed].copy()
        candidates[seed] = False
        while candidates.any():
            left = np.flatnonzero(candidates)
            chosen = int(left[np.argmax(agree[np.ix_(left, left)].sum(axis=1))])
            members.append(chosen)
            candidates &= agree[chosen]
            candidates[chosen] = False
        best = max(best, members, key=len)
    return np.array(best, dtype=np.int64)
