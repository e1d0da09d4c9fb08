"""Pose-graph relaxation: poses alone, from measured transforms between vertices.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-D (pose-graph relaxation).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mapstream.operators.estimation.batch import (
    OptimizationReport,
    OptimizeConfig,
    optimize_map,
)
from mapstream.operators.maps.loops import LoopsReport, close_loops
from mapstream.recordings.maps.build import with_poses
from mapstream.recordings.maps.combine import select_missions
from mapstream.recordings.maps.edge_kinds import RELATIVE_KINDS
from mapstream.recordings.maps.model import Map
from mapstream.streams.messages.estimates import RelativePose


@dataclass(frozen=True, slots=True, kw_only=True)
class RelaxReport:
    """What came of a relaxation."""

    loops: LoopsReport  # that took part, and are not in the map
    solved: tuple[OptimizationReport, ...]  # one for all missions, or one for each


def relax_map(
    map_: Map, loops: Sequence[RelativePose] = (), config: OptimizeConfig | None = None
) -> tuple[Map, RelaxReport]:
    """Return the map with all poses relaxed; loops given here take part, and are not in the map after.

    Raises:
        EstimationError: If the edges do not determine the poses.
    """
    with_loops, report = close_loops(map_, loops)
    solved, solution = optimize_map(with_loops, _relative(config))
    switch = solved.edges.switch[: len(map_.edges)]  # temporary loops are the last rows
    relaxed = replace(
        map_,
        missions=solved.missions,
        vertices=solved.vertices,
        edges=replace(map_.edges, switch=switch),
    )
    return relaxed, RelaxReport(loops=report, solved=(solution,))


def relax_missions(
    map_: Map,
    mission_rows: Sequence[int],
    loops: Sequence[RelativePose] = (),
    config: OptimizeConfig | None = None,
) -> tuple[Map, RelaxReport]:
    """Return the map with the poses of each of these missions relaxed for itself.

    Edges between missions take no part, and switches stay as they are.

    Raises:
        EstimationError: If the edges do not determine the poses of a mission.
    """
    with_loops, report = close_loops(map_, loops)
    solutions = []
    for row in mission_rows:
        alone = select_missions(with_loops, [map_.mission_id(row)])
        solved, solution = optimize_map(alone, _relative(config))
        poses = solved.T_map_base(solved.vertices_of(0))
        T_mission_map = map_.missions.T_map_mission_of(row).inverse().matrix
        map_ = with_poses(map_, map_.vertices_of(row), T_mission_map @ poses)
        solutions.append(solution)
    return map_, RelaxReport(loops=report, solved=tuple(solutions))


def _relative(config: OptimizeConfig | None) -> OptimizeConfig:
    return (config or OptimizeConfig()).model_copy(update={"kinds": RELATIVE_KINDS})
