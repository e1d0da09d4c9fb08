"""A map that grows by submaps and loops, and stays optimised."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapstream.operators.estimation.batch import (
    OptimizationReport,
    OptimizeConfig,
    optimize_map,
)
from mapstream.operators.estimation.fixing import fixed
from mapstream.operators.estimation.incremental import IncrementalProblem
from mapstream.operators.estimation.kinds import make_factors
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.operators.estimation.symbols import PoseSymbols
from mapstream.recordings.maps.build import add_edges, anchored
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, invert
from mapstream.streams.messages.estimates import MapCorrection, RelativePose, Submap

_CONSISTENT_CHI2 = 16.8  # per loop: 99 % of a chi2 with six degrees of freedom


class LiveMap:
    """The map, and the incremental problem behind it; symbols of poses are rows of vertices.

    Loops enter as plain factors, since a robust cost would throw out a true loop that contradicts drift.
    When the loops contradict each other or the rest, the batch solver says which are false, and their
    factors leave the problem; they stay in the map with the switch that they got.
    """

    def __init__(self, config: OptimizeConfig, T_map_first: SE3 | None = None) -> None:
        self.map = Map.empty()
        self._T_map_first = T_map_first or SE3.identity()  # where the first mission begins
        self.num_contradictions = 0
        self._config = config
        self._problem = IncrementalProblem()
        self._symbols = PoseSymbols()
        self._noise_of = NoiseModels()
        self._newest: dict[str, SE3] = {}  # mission -> T_odom_base of its newest vertex

    def append(self, submap: Submap, *, mission_name: str = "") -> None:
        """Add a submap's vertices and edges, and solve.

        Raises:
            MapError: If it is not the next one of its mission.
            EstimationError: If its edges do not determine its poses.
        """
        num_vertices, num_edges = len(self.map.vertices), len(self.map.edges)
        self.map = append_submap(self.map, submap, mission_name=mission_name)
        if num_vertices == 0:
            self.map = anchored(self.map, 0, self._T_map_first)
        for keyframe in submap.keyframes:
            self._symbols.pose_at(submap.mission_id, keyframe.stamp_ns)
        self._require_rows_are_symbols()
        poses = self.map.T_map_base(np.arange(num_vertices, len(self.map.vertices)))
        factors = self._factors(num_edges)
        if submap.index == 0:  # a new mission: nothing ties it to the others yet
            factors[_hold(num_vertices)] = fixed(num_vertices, poses[0])
        self._problem.update(poses=poses, add=factors)
        self._newest[submap.mission_id] = submap.keyframes[-1].odometry.T_odom_base
        self._take_poses()

    def close_loops(self, edges: Sequence[RelativePose]) -> None:
        """Add loops between vertices of the map, and solve; false ones are switched off.

        Raises:
            MapError: If a loop ends where there is no vertex.
        """
        if not edges:
            return
        num_edges = len(self.map.edges)
        self.map = add_edges(self.map, edges)
        factors = self._factors(num_edges)
        before = self._problem.chi2()
        self._problem.update(poses=np.zeros((0, 4, 4)), add=factors)
        self._problem.settle()
        self._take_poses()
        if self._problem.chi2() - before > _CONSISTENT_CHI2 * len(edges):
            self._settle_contradiction()

    def finish(self) -> OptimizationReport:
        """Optimise the whole map in one batch; its poses and switches are the final ones.

        Raises:
            EstimationError: If the map has no finite solution.
        """
        self.map, report = optimize_map(self.map, self._config)
        return report

    def correction(self, mission_id: str) -> MapCorrection:
        """Return the present poses of a mission, and where its odometry frame lies."""
        trajectory = self.map.trajectory(mission_id)
        newest = SE3(trajectory.poses[-1])
        row = self.map.mission_row(mission_id)
        is_known = bool(self.map.missions.is_base_frame_known[row])
        return MapCorrection(
            stamp_ns=int(trajectory.stamps_ns[-1]),
            mission_id=mission_id,
            stamps_ns=trajectory.stamps_ns,
            T_mission_base=trajectory.poses,
            T_mission_odom=newest @ self._newest[mission_id].inverse(),
            T_map_mission=self.map.missions.T_map_mission_of(row) if is_known else None,
        )

    def _require_rows_are_symbols(self) -> None:
        if len(self._symbols) != len(self.map.vertices):
            counts = f"{len(self._symbols)} symbols, {len(self.map.vertices)} vertices"
            raise EstimationError(f"two keyframes of one mission share a stamp: {counts}")

    def _factors(self, first_edge: int) -> dict[int, Factor]:
        rows = range(first_edge, len(self.map.edges))
        return make_factors(self.map, rows, self._noise_of)

    def _take_poses(self) -> None:
        T_mission_map = invert(self.map.missions.T_map_mission)
        poses = T_mission_map[self.map.vertices.mission] @ self._problem.poses()
        self.map = replace(self.map, vertices=replace(self.map.vertices, T_mission_base=poses))

    def _settle_contradiction(self) -> None:
        """Ask the batch solver which loops are false, and go on without their factors."""
        self.num_contradictions += 1
        self.map, _ = optimize_map(self.map, self._config)
        edges = self.map.edges
        is_true = ~edges.is_switchable | (edges.switch >= 0.5)
        rows = np.flatnonzero(is_true).tolist()
        factors = make_factors(self.map, rows, self._noise_of)
        poses = self.map.T_map_base(np.arange(len(self.map.vertices)))
        for row in range(len(self.map.missions)):
            first = int(self.map.vertices_of(row)[0])
            factors[_hold(first)] = fixed(first, poses[first])
        self._problem.reset(poses, factors)
        self._take_poses()


def _hold(vertex: int) -> int:
    """Return the number of the factor that holds a vertex; those of edges are their rows, from 0."""
    return -1 - vertex
