"""Absolute measurements that contradict the others of their mission, found and switched off.

The trajectory of a mission is rigid enough to say where each fix should be: RANSAC over the transform between the
trajectory and the outer frame, then least squares on those that agree (maplab's rejection of absolute outliers,
Cramariuc et al., RA-L 2023, section III-D; Fischler and Bolles, CACM 1981).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from pydantic import BaseModel, ConfigDict, PositiveFloat, PositiveInt

from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

_KINDS = ("absolute", "position")
_LEAST = 3  # fixes below which none can be told to be wrong
_MIN_SPREAD_M = 1e-3


class RejectAbsoluteConfig(BaseModel):
    """How absolute measurements are found to be false."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    threshold_m: PositiveFloat = 0.5
    """A fix may lie this far from where the others put it, besides its own uncertainty."""
    num_sigmas: PositiveFloat = 3.0
    """Of the fix's own uncertainty."""
    window: PositiveInt = 40
    """Fixes next to each other in time over which odometry does not drift much."""
    num_samples: PositiveInt = 200
    """Triples that are tried in each window."""
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class RejectAbsoluteReport:
    """Which absolute measurements are false."""

    num_fixes: int
    num_untouched: int  # of missions with too few to tell
    rejected: list[int]  # rows of edges


def reject_absolute(
    map_: Map,
    config: RejectAbsoluteConfig | None = None,
    *,
    missions: Collection[int] | None = None,
) -> tuple[Map, RejectAbsoluteReport]:
    """Return the map with the switch 0 on absolute measurements that contradict the others.

    Where there are fewer than three of one frame and one mission, none is touched. A switch that was 0 before is
    looked at again.

    Args:
        map_: Whose missions have trajectories that are rigid over a window of fixes.
        config: What counts as a contradiction.
        missions: Their rows; left out, all missions.
    """
    config = config or RejectAbsoluteConfig()
    edges = map_.edges
    rows = np.flatnonzero(np.isin(edges.kind, _KINDS) & (edges.vertex_a >= 0))
    if missions is not None:
        rows = rows[np.isin(map_.vertices.mission[edges.vertex_a[rows]], list(missions))]
    mission = map_.vertices.mission[edges.vertex_a[rows]]
    rng = np.random.default_rng(config.seed)
    switch, untouched, rejected = edges.switch.copy(), 0, []
    for group in np.unique(np.column_stack([mission, edges.frame[rows]]), axis=0):
        mine = rows[(mission == group[0]) & (edges.frame[rows] == group[1])]
        if len(mine) < _LEAST:
            untouched += len(mine)
            continue
        is_true = _agreeing(map_, mine, config, rng)
        switch[mine] = is_true
        rejected += mine[~is_true].tolist()
    report = RejectAbsoluteReport(
        num_fixes=len(rows), num_untouched=untouched, rejected=sorted(rejected)
    )
    return replace(map_, edges=replace(edges, switch=switch)), report


def _agreeing(
    map_: Map, rows: IntArray, config: RejectAbsoluteConfig, rng: np.random.Generator
) -> BoolArray:
    """Return which fixes (N,) agree with most of those around them in time."""
    edges, vertices = map_.edges, map_.vertices
    order = np.argsort(vertices.stamp_ns[edges.vertex_a[rows]], kind="stable")
    rows = rows[order]
    here = vertices.T_mission_base[edges.vertex_a[rows], :3, 3]
    there = edges.T_a_b[rows, :3, 3]
    variance = np.diagonal(edges.covariance[rows], axis1=1, axis2=2)[:, 3:].max(axis=1)
    tolerance = np.hypot(config.threshold_m, config.num_sigmas * np.sqrt(variance))
    agreeing = np.zeros(len(rows), dtype=bool)
    step = max(1, config.window // 2)
    votes, seen = np.zeros(len(rows)), np.zeros(len(rows))
    for first in range(0, max(1, len(rows) - step), step):
        part = slice(first, first + config.window)
        votes[part] += _consensus(here[part], there[part], tolerance[part], config, rng)
        seen[part] += 1
    agreeing[order] = votes > seen / 2
    return agreeing


def _consensus(
    here: FloatArray,
    there: FloatArray,
    tolerance: FloatArray,
    config: RejectAbsoluteConfig,
    rng: np.random.Generator,
) -> BoolArray:
    """Return which points (N,) one rigid transform explains."""
    num = len(here)
    best = np.ones(num, dtype=bool)
    if num < _LEAST:
        return best
    best_cost = np.inf
    for _ in range(config.num_samples):
        sample = rng.choice(num, _LEAST, replace=False)
        error = _error(here, there, sample)
        cost = float(np.minimum((error / tolerance) ** 2, 1.0).sum())
        if cost < best_cost:
            best, best_cost = error < tolerance, cost
    for _ in range(5):  # least squares on those that agree, until they stay the same
        if best.sum() < _LEAST:
            break
        again = _error(here, there, np.flatnonzero(best)) < tolerance
        if np.array_equal(again, best):
            break
        best = again
    return best


def _error(here: FloatArray, there: FloatArray, chosen: IntArray) -> FloatArray:
    """Return how far (N,) points are from each other under the transform that suits the chosen ones best.

    Source: Umeyama, PAMI 1991, without scale.
    """
    a, b = here[chosen], there[chosen]
    middle_a, middle_b = a.mean(axis=0), b.mean(axis=0)
    left, _, right = np.linalg.svd((b - middle_b).T @ (a - middle_a))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    R = left @ flip @ right
    error: FloatArray = np.linalg.norm((here - middle_a) @ R.T + middle_b - there, axis=1)
    return error
