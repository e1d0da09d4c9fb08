"""A map that grows by submaps and loops, and stays optimised."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mapstream.operators.backend.holds import all_holds, new_holds
from mapstream.operators.estimation.batch import (
    OptimizationReport,
    OptimizeConfig,
    optimize_map,
)
from mapstream.operators.estimation.factors.inertial import outdated
from mapstream.operators.estimation.incremental import IncrementalProblem
from mapstream.operators.estimation.kinds import make_factors
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.operators.estimation.outliers.fix_judge import FixJudge, with_verdicts
from mapstream.operators.estimation.outliers.lonely_fixes import lonely_fixes
from mapstream.operators.estimation.problem import with_loss
from mapstream.operators.estimation.starts.first_fixes import FirstFixes, headed, is_linked
from mapstream.operators.estimation.starts.inertial_start import dead_reckoned, with_known_biases
from mapstream.operators.estimation.states import initial_values, with_solution
from mapstream.operators.estimation.symbols import PoseSymbols
from mapstream.operators.maps.quality import require_no_worse
from mapstream.recordings.maps.build import add_edges, anchored
from mapstream.recordings.maps.ids import as_keys
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.order import in_canonical_order
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapCorrection, RelativePose, Submap

_CONSISTENT_CHI2 = 16.8  # per loop: 99 % of a chi2 with six degrees of freedom


class LiveMap:
    """The map, and the incremental problem behind it; symbols of poses are rows of vertices.

    Rows stay where they are while it grows, so vertices that came late lie behind newer ones; `ordered` is
    the map as it goes out.
    Loops enter as plain factors, since a robust cost would throw out a true loop that contradicts drift.
    When the loops contradict each other or the rest, the batch solver says which are false, and their
    factors leave the problem; they stay in the map with the switch that they got.
    Where absolute measurements may be false, those on missions that only an IMU leads along enter once it is sure
    that they are true (`fix_judge.py`), and leave when later ones say otherwise; the others are switched off.
    """

    def __init__(self, config: OptimizeConfig, T_map_first: SE3 | None = None) -> None:
        self.map = Map.empty()
        self._T_map_first = T_map_first or SE3.identity()  # where the first mission begins
        self.num_contradictions = 0
        self.refused = ""  # why the last batch did not count, if it did not
        self._config = config
        self._problem = IncrementalProblem()
        self._symbols = PoseSymbols()
        self._noise_of = NoiseModels()
        self._seen: set[bytes] = set()  # ids of edges that are in the problem, or were found false
        self._fixes = FirstFixes()
        self._judge = FixJudge() if config.reject_absolute else None
        self._newest: dict[str, SE3] = {}  # mission -> T_odom_base of its newest vertex

    def ordered(self) -> Map:
        """Return the map with its rows in the canonical order."""
        return in_canonical_order(self.map)

    def append(self, submap: Submap, *, mission_name: str = "") -> None:
        """Add a submap's vertices, edges and measurements, take out the edges that it splits, and solve.

        Raises:
            MapError: If it is not the next one of its mission.
            EstimationError: If its edges do not determine its poses.
        """
        num_vertices = len(self.map.vertices)
        self.map = append_submap(self.map, submap, mission_name=mission_name)
        if num_vertices == 0:
            self.map = anchored(self.map, 0, self._T_map_first)
        for keyframe in [*(splice.keyframe for splice in submap.splices), *submap.keyframes]:
            self._symbols.pose_at(submap.mission_id, keyframe.stamp_ns)
        self._require_rows_are_symbols()
        self._solve_with(np.arange(num_vertices, len(self.map.vertices)))
        self._newest[submap.mission_id] = submap.keyframes[-1].odometry.T_odom_base

    def close_loops(self, edges: Sequence[RelativePose]) -> None:
        """Add loops between vertices of the map, and solve; false ones are switched off.

        Raises:
            MapError: If a loop ends where there is no vertex.
        """
        if not edges:
            return
        before = self._problem.chi2()
        self.map = add_edges(self.map, edges)
        self._solve_with(np.empty(0, dtype=np.int64))
        self._problem.settle()
        self._take()
        if self._problem.chi2() - before > _CONSISTENT_CHI2 * len(edges):
            self._settle_contradiction()

    def finish(self) -> OptimizationReport:
        """Optimise the whole map in one batch; its states and switches are the final ones.

        A solution that bends missions far beyond the noise of their own motion is refused: then the map stays as it
        was, and `refused` says why.

        Raises:
            EstimationError: If the map has no finite solution.
        """
        if self._judge is not None:
            self._solve_with(np.empty(0, dtype=np.int64), is_whole=True)
        before = self.map = self.ordered()
        report = self._optimize()
        try:
            require_no_worse(before, self.map, may_switch=self._config.is_robust)
        except EstimationError as error:
            self.map, self.refused = before, str(error)
        return report

    def _optimize(self) -> OptimizationReport:
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

    def _names(self) -> dict[bytes, int]:
        """Return the row of each edge by the name of its factor, which is the edge's id."""
        return {name: at for at, name in enumerate(as_keys(self.map.edges.id).tolist())}

    def _solve_with(self, new_vertices: IntArray, *, is_whole: bool = False) -> None:
        """Bring the problem to the edges of the map, of which no more come if it is whole; take its solution."""
        self.map = with_known_biases(self.map, new_vertices)
        rows, off = self._names(), self._switch_fixes(is_whole=is_whole)
        gone = (self._seen - rows.keys()) | (self._seen & off)
        self._seen -= gone
        meeting = [f for f in self._fixes.meet(self.map) if not is_linked(self.map, f)]
        fresh = {n: row for n, row in rows.items() if n not in self._seen and n not in off}
        waiting = self._fixes.waiting(self.map, fresh.values())
        named = self._made([row for row in fresh.values() if row not in waiting])
        inertial = {rows[n]: f for n, f in named.items() if self.map.edges.kind[rows[n]] == "imu"}
        self.map = dead_reckoned(self.map, inertial, new_vertices)
        asleep = self._fixes.asleep(self.map)
        named = {n: f for n, f in named.items() if self._mission_of(rows[n]) not in asleep}
        self._seen |= named.keys()
        if meeting:
            for fixes in meeting:
                self.map = headed(self.map, fixes, self._softened)
            self._start_anew()
        elif named or gone:
            held = self._holds({rows[n]: f for n, f in named.items()}, new_vertices)
            values = initial_values(self.map, self._problem.new_keys((named | held).values()))
            gone &= self._problem.factors.keys()
            self._problem.update(values, named | held, sorted(gone))
            self._take()
            self._integrate_anew(rows)

    def _switch_fixes(self, *, is_whole: bool) -> set[bytes]:
        """Switch fixes by what is known of them now, where only an IMU leads; return those that are off."""
        if self._judge is None:
            return set()
        self.map = with_verdicts(self.map, self._judge.verdicts(self.map, is_whole=is_whole))
        fixes, edges = lonely_fixes(self.map), self.map.edges
        return set(as_keys(edges.id[fixes[edges.switch[fixes] == 0]]).tolist())

    def _mission_of(self, edge: int) -> int:
        vertex = self.map.edges.vertex_a[edge]
        return int(self.map.vertices.mission[vertex]) if vertex >= 0 else -1

    def _made(self, rows: Sequence[int]) -> dict[bytes, Factor]:
        """Return a factor by name for each of these edges whose kind is known."""
        factors = make_factors(self.map, rows, self._noise_of)
        return {
            self.map.edges.id[row].tobytes(): self._softened(row, factor)
            for row, factor in factors.items()
        }

    def _softened(self, row: int, factor: Factor, widening: float = 1.0) -> Factor:
        loss = self._config.losses.get(self.map.edges.kind[row])
        if loss is None:
            return factor
        return with_loss(factor, loss, widening * self._config.loss_width)

    def _holds(self, factors: dict[int, Factor], new_vertices: IntArray) -> dict[bytes, Factor]:
        """Return what holds missions that begin here, and weak priors on new variables of other kinds."""
        missions = np.unique(self.map.vertices.mission[new_vertices]).tolist()
        begun = [m for m in missions if self.map.mission_id(m) not in self._newest]
        return new_holds(self.map, factors, begun, self._problem.new_keys(factors.values()))

    def _integrate_anew(self, rows: Mapping[bytes, int]) -> None:
        """Replace IMU factors whose bias has moved too far since their samples were integrated."""
        names = as_keys(self.map.edges.id[self.map.edges_of("imu")]).tolist()
        factors = self._problem.factors
        stale = outdated(self.map, {rows[n]: factors[n] for n in names if n in factors})
        if stale:
            named = self._made(stale)
            self._problem.update(initial_values(self.map, []), named, list(named))
            self._take()

    def _take(self) -> None:
        self.map = with_solution(self.map, self._problem.values())

    def _settle_contradiction(self) -> None:
        """Ask the batch solver which loops are false, and go on without their factors."""
        self.num_contradictions += 1
        self._optimize()
        self._start_anew()

    def _start_anew(self) -> None:
        """Begin the problem again with the map as it is, less edges that were switched off."""
        edges = self.map.edges
        is_on = edges.switch >= 0.5
        rows = [at for at, row in enumerate(edges.id) if is_on[at] and row.tobytes() in self._seen]
        named, row_of = self._made(rows), self._names()
        factors = {row_of[name]: factor for name, factor in named.items()}
        named |= all_holds(self.map, factors)
        keys = {key for factor in named.values() for key in factor.keys()}  # noqa: SIM118  # gtsam's
        self._problem.reset(initial_values(self.map, keys), named)
        self._take()
