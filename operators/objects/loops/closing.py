"""Semantic loop closure of a stored map: objects seen again become edges, and if asked for, one landmark.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section IV-D.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass

import numpy as np
from pydantic import PositiveFloat

from mapstream.operators.landmarks.merging import merge_landmarks
from mapstream.operators.maps.loops import delete_loops
from mapstream.operators.objects.loops.edges import SOURCE
from mapstream.operators.objects.loops.search import ACCEPTED, ObjectSearch, SearchConfig, Searched
from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import concatenate
from mapstream.streams.arrays import IntArray


class SemanticLoopsConfig(SearchConfig):
    """How semantic loops are found and what becomes of them."""

    stretch_s: PositiveFloat = 5.0
    """What a robot saw in so long is compared with all that was seen before; each may close a loop."""
    is_anew: bool = True
    """Edges of semantic loops that the map has go first: after an optimisation they are found again, and better."""
    is_merging: bool = False
    """Landmarks that are the same become one, so that bundle adjustment uses them, too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedObjects:
    """Two objects of one class, and why they are or are not the same."""

    landmark_a: str  # ids
    landmark_b: str
    label: str
    distance_m: float  # by the poses of the map
    verdict: str  # "accepted", or the reason


@dataclass(frozen=True, slots=True, kw_only=True)
class ClosedLoop:
    """One edge and what it rests on."""

    mission_a: str
    stamp_a_ns: int
    mission_b: str
    stamp_b_ns: int
    num_objects: int
    rmse_m: float
    chance: float  # how many such clusters unrelated objects would give
    sigma_rad: float  # along the worst axis
    sigma_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SemanticLoopsReport:
    """What was compared, and what came of it."""

    num_edges: int
    num_merged: int  # landmarks that are now part of another
    reasons: dict[str, int]  # why objects were not taken for the same
    loops: list[ClosedLoop]
    candidates: list[ComparedObjects]

    def lines(self) -> list[str]:
        """Return what to tell people."""
        return [
            f"{self.num_edges} loops closed by objects, {self.num_merged} landmarks merged",
            *(
                f"loop of {loop.num_objects} objects, {loop.rmse_m:.3f} m apart after it"
                for loop in self.loops
            ),
            *(f"not the same: {num}: {reason}" for reason, num in self.reasons.items()),
        ]


def close_semantic_loops(
    map_: Map, config: SemanticLoopsConfig | None = None
) -> tuple[Map, SemanticLoopsReport]:
    """Return the map with an edge for each place whose objects were seen before, and what became of candidates.

    Landmarks of objects must be there: `object_landmarks` makes them, with a limit on the time within which it
    takes things for one.
    """
    config = config or SemanticLoopsConfig()
    if config.is_anew:
        map_, _ = delete_loops(map_, source=SOURCE)
    search = ObjectSearch(map_, config)
    searched = [
        search.search(vertices, num_missions=mission + 1)
        for mission in range(len(map_.missions))
        for vertices in stretches(map_, mission, config.stretch_s)
    ]
    loops = [(each, loop) for each in searched for loop in each.loops]
    compared = [pair for each in searched for pair in compared_objects(map_, each)]
    edges = [loop.edge for _, loop in loops]
    changed = append_edges(map_, concatenate(edges)) if edges else map_
    num_merged = 0
    if config.is_merging and loops:
        pairs = [
            each.objects.landmark[np.stack([each.candidates.a, each.candidates.b], axis=1)][
                loop.pairs
            ]
            for each, loop in loops
        ]
        changed, merged = merge_landmarks(changed, np.concatenate(pairs))
        num_merged = merged.num_merged
    reasons = Counter(kind_of(pair.verdict) for pair in compared if pair.verdict != ACCEPTED)
    return changed, SemanticLoopsReport(
        num_edges=len(edges),
        num_merged=num_merged,
        reasons=dict(sorted(reasons.items())),
        loops=[closed_loop(map_, each, row) for each in searched for row in range(len(each.loops))],
        candidates=compared,
    )


def stretches(map_: Map, mission: int, stretch_s: float) -> list[IntArray]:
    """Return the vertices of a mission, cut into stretches of time."""
    rows = map_.vertices_of(mission)
    stamps_ns = map_.vertices.stamp_ns[rows]
    part = (stamps_ns - stamps_ns[:1]) // round(stretch_s * 1e9)
    return np.split(rows, np.flatnonzero(np.diff(part)) + 1)


def compared_objects(map_: Map, searched: Searched) -> list[ComparedObjects]:
    """Return what became of each pair of objects."""
    objects, found = searched.objects, searched.candidates
    ids = [row.tobytes().hex() for row in map_.landmarks.id[objects.landmark]]
    rows = zip(
        found.a.tolist(), found.b.tolist(), found.distance_m.tolist(), found.verdict, strict=True
    )
    return [
        ComparedObjects(
            landmark_a=ids[a],
            landmark_b=ids[b],
            label=str(objects.label[a]),
            distance_m=distance_m,
            verdict=str(verdict),
        )
        for a, b, distance_m, verdict in rows
    ]


def closed_loop(map_: Map, searched: Searched, row: int) -> ClosedLoop:
    """Return what a loop rests on."""
    loop, vertices = searched.loops[row], map_.vertices
    a, b = int(loop.edge.vertex_a[0]), int(loop.edge.vertex_b[0])
    covariance = loop.edge.covariance[0]
    sigma_rad, sigma_m = (
        float(np.sqrt(np.linalg.eigvalsh(part)[-1]))
        for part in (covariance[:3, :3], covariance[3:, 3:])
    )
    return ClosedLoop(
        mission_a=map_.mission_id(int(vertices.mission[a])),
        stamp_a_ns=int(vertices.stamp_ns[a]),
        mission_b=map_.mission_id(int(vertices.mission[b])),
        stamp_b_ns=int(vertices.stamp_ns[b]),
        num_objects=len(loop.pairs),
        rmse_m=loop.agreement.rmse_m,
        chance=loop.agreement.chance,
        sigma_rad=sigma_rad,
        sigma_m=sigma_m,
    )


def kind_of(verdict: str) -> str:
    """Return a verdict without its numbers, so that verdicts can be counted."""
    return re.sub(r"\d[\d.e+-]* ?", "", verdict)
