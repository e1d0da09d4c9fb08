"""Fewer vertices: those that say little beyond the one before them go, and the edges between are merged.

Source: maplab's command keyframe_heuristic (kfh), whose seven rules and thresholds these are.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from mapstream.operators.landmarks.covisibility import points_of
from mapstream.operators.maps.landmark_homes import without_vertices
from mapstream.operators.maps.linking import linked
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.edge_kinds import MOTION_KINDS
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, IntArray
from mapstream.streams.geometry import invert, so3_log


class KeyframingConfig(OperatorConfig):
    """When a vertex is kept; the first and the last one of a mission always are."""

    every: PositiveInt = 10
    """At the latest, so many vertices after the last one that was kept."""
    min_common_points: NonNegativeInt = 20
    """A vertex that sees fewer of the points that the last kept one sees is kept."""
    min_distance_m: PositiveFloat = 0.75
    """From the last kept vertex."""
    min_angle_rad: PositiveFloat = float(np.deg2rad(20))
    keep_absolute: bool = True
    """Vertices with an absolute measurement are kept."""
    keep_loops: bool = True
    """Vertices with a loop closure are kept."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyframingReport:
    """What went, and why vertices stayed."""

    num_before: int
    num_kept: int
    reasons: dict[str, int]  # of kept vertices, by the first rule that kept them
    num_merged_edges: int  # that lead over vertices which went
    lost_edges: dict[str, int]  # by kind: they ended at vertices which went, and cannot be merged


def keyframe(map_: Map, config: KeyframingConfig | None = None) -> tuple[Map, KeyframingReport]:
    """Return the map with keyframes alone; landmarks that one of them sees stay."""
    config = config or KeyframingConfig()
    reasons: Counter[str] = Counter()
    keep = np.zeros(len(map_.vertices), bool)
    stretches = []
    for mission in range(len(map_.missions)):
        rows = map_.vertices_of(mission)
        kept = _kept(map_, rows, config, reasons)
        keep[rows[kept]] = True
        stretches += [rows[a : b + 1] for a, b in pairwise(kept) if b > a + 1]
    over, num_merged = linked(map_, stretches)
    left = without_vertices(over, keep)
    return left, KeyframingReport(
        num_before=len(map_.vertices),
        num_kept=int(keep.sum()),
        reasons=dict(sorted(reasons.items())),
        num_merged_edges=num_merged,
        lost_edges=_lost(map_, keep),
    )


def _kept(map_: Map, rows: IntArray, config: KeyframingConfig, reasons: Counter[str]) -> list[int]:
    """Return the places of a mission's vertices (N,) that stay, in order."""
    seen = _points_by_vertex(map_, rows)
    sees_any = any(len(points) for points in seen)
    poses = map_.vertices.T_mission_base[rows]
    has_absolute = _has_edge(map_, ("absolute", "position", "fixed"))[rows] & config.keep_absolute
    has_loop = _has_edge(map_, ("loop",))[rows] & config.keep_loops
    kept: list[int] = []
    for at in range(len(rows)):
        reason = ""
        if at in (0, len(rows) - 1):
            reason = "first or last"
        elif has_absolute[at]:
            reason = "absolute measurement"
        elif has_loop[at]:
            reason = "loop"
        else:
            last = kept[-1]
            motion = invert(poses[last]) @ poses[at]
            common = np.isin(seen[at], seen[last], assume_unique=True).sum()
            rules = {
                "every": at - last >= config.every,
                "few common points": sees_any and common < config.min_common_points,
                "distance": np.linalg.norm(motion[:3, 3]) >= config.min_distance_m,
                "angle": np.linalg.norm(so3_log(motion[:3, :3])) >= config.min_angle_rad,
            }
            reason = next((name for name, holds in rules.items() if holds), "")
        if reason:
            reasons[reason] += 1
            kept.append(at)
    return kept


def _points_by_vertex(map_: Map, rows: IntArray) -> list[IntArray]:
    """Return the points that each of these vertices sees, none twice."""
    points, place = points_of(map_, rows)
    pairs = np.unique(np.stack([place, points]), axis=1)
    cuts = np.searchsorted(pairs[0], np.arange(1, len(rows)))
    return np.split(pairs[1], cuts)


def _has_edge(map_: Map, kinds: tuple[str, ...]) -> BoolArray:
    """Return which vertices (V,) an edge of these kinds ends at."""
    rows = np.isin(map_.edges.kind, kinds)
    ends = np.concatenate([map_.edges.vertex_a[rows], map_.edges.vertex_b[rows]])
    has = np.zeros(len(map_.vertices), bool)
    has[ends[ends >= 0]] = True
    return has


def _lost(map_: Map, keep: BoolArray) -> dict[str, int]:
    """Return by kind how many edges that are no motion between two vertices end at vertices that go."""
    edges, stays = map_.edges, np.append(keep, True)  # the last stands for no vertex
    goes = ~stays[edges.vertex_a] | ~stays[edges.vertex_b]
    goes &= ~np.isin(edges.kind, (*MOTION_KINDS, "imu"))
    return dict(sorted(Counter(edges.kind[goes].tolist()).items()))
