"""What is in a map, in numbers."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MissionStatistics:
    """One mission in numbers."""

    mission_id: str
    name: str
    is_anchored: bool
    T_map_mission: FloatArray  # (4, 4) the base frame, as good as it is known
    num_vertices: int
    start_ns: int  # 0 of a mission without vertices, as are the times below
    duration_s: float
    step_s: float  # the median time between vertices
    longest_gap_s: float
    length_m: float  # along the vertices
    num_observations: int


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeStatistics:
    """The edges of one kind in numbers."""

    kind: str
    count: int
    num_between_missions: int
    num_switched_off: int  # that an optimizer found false


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapStatistics:
    """A map in numbers."""

    digest: str
    num_rows: dict[str, int]  # by table
    missions: tuple[MissionStatistics, ...]
    edges: tuple[EdgeStatistics, ...]  # by kind, in alphabetical order
    landmarks: dict[str, int]  # by kind
    objects: dict[str, int]  # landmarks by class
    regions: dict[str, int]  # by kind
    resources: dict[str, int]  # by kind
    coobservability: IntArray  # (M, M) landmarks that are observed from both missions

    @property
    def length_m(self) -> float:
        return sum(mission.length_m for mission in self.missions)


def map_statistics(map_: Map) -> MapStatistics:
    """Count and measure what is in a map, whose references all lead somewhere."""
    kinds = sorted(set(map_.edges.kind))
    return MapStatistics(
        digest=map_.digest(),
        num_rows={name: len(table) for name, table in map_.tables().items()},
        missions=tuple(_mission(map_, row) for row in range(len(map_.missions))),
        edges=tuple(_edges(map_, kind) for kind in kinds),
        landmarks=_counts(map_.landmarks.kind.tolist()),
        objects=_counts([label for label in map_.landmarks.label.tolist() if label]),
        regions=_counts(map_.regions.kind.tolist()),
        resources=_counts(map_.resources.kind.tolist()),
        coobservability=coobservability(map_),
    )


def coobservability(map_: Map) -> IntArray:
    """Return how many landmarks are observed from vertices of both missions (M, M)."""
    seen = map_.observations.landmark >= 0
    missions = map_.vertices.mission[map_.observations.vertex[seen]]
    pairs = np.unique(np.column_stack([map_.observations.landmark[seen], missions]), axis=0)
    num_missions = len(map_.missions)
    counts = np.zeros((num_missions, num_missions), dtype=np.int64)
    starts = np.flatnonzero(np.diff(pairs[:, 0], prepend=-1))
    for observers in np.split(pairs[:, 1], starts[1:]):
        counts[np.ix_(observers, observers)] += 1
    return counts


def _mission(map_: Map, row: int) -> MissionStatistics:
    rows = map_.vertices_of(row)
    positions = map_.vertices.T_mission_base[rows, :3, 3]
    stamps_ns = map_.vertices.stamp_ns[rows]
    steps_s = np.diff(stamps_ns) / 1e9 if len(rows) > 1 else np.zeros(1)
    return MissionStatistics(
        mission_id=map_.mission_id(row),
        name=map_.missions.name[row],
        is_anchored=bool(map_.missions.is_base_frame_known[row]),
        T_map_mission=map_.missions.T_map_mission[row],
        num_vertices=len(rows),
        start_ns=int(stamps_ns[0]) if len(rows) else 0,
        duration_s=float(np.ptp(stamps_ns)) / 1e9 if len(rows) else 0.0,
        step_s=float(np.median(steps_s)),
        longest_gap_s=float(steps_s.max()),
        length_m=float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        num_observations=int((map_.vertices.mission[map_.observations.vertex] == row).sum()),
    )


def _edges(map_: Map, kind: str) -> EdgeStatistics:
    edges, rows = map_.edges, map_.edges_of(kind)
    mission = np.append(map_.vertices.mission, -1)  # the last is that of no vertex
    a, b = mission[edges.vertex_a[rows]], mission[edges.vertex_b[rows]]
    return EdgeStatistics(
        kind=kind,
        count=len(rows),
        num_between_missions=int(((a != b) & (b >= 0)).sum()),
        num_switched_off=int((edges.switch[rows] < 0.5).sum()),
    )


def _counts(words: list[str]) -> dict[str, int]:
    return dict(sorted(Counter(words).items()))
