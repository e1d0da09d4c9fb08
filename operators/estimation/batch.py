"""The whole map as one problem: Levenberg-Marquardt over all poses, with loops that may be switched off.

Loops are switched by graduated non-convexity (Yang et al., RA-L 2020) on the Geman-McClure cost, which is the
switchable constraint of Suenderhauf and Protzel (IROS 2012) with the switch eliminated: the cost starts nearly
convex, so that a true loop which contradicts a drifted start is not thrown away with the false ones.
"""

from __future__ import annotations

import math
import re
import time
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import gtsam
import numpy as np
from pydantic import BaseModel, ConfigDict, PositiveFloat, PositiveInt

from mapstream.operators.estimation.fixing import fixed
from mapstream.operators.estimation.kinds import make_factors, makers
from mapstream.operators.estimation.noise import Factor, NoiseModels, switch_of, switchable
from mapstream.operators.estimation.states import poses_from, values_from, with_solution
from mapstream.recordings.maps.model import Map
from mapstream.streams.errors import EstimationError
from mapstream.streams.messages.sensors import FloatArray, IntArray

_ANNEALING = 4.0  # each round makes the robust cost this much less convex


class OptimizeConfig(BaseModel):
    """How a map is optimised."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    solver: Literal["lm", "dogleg"] = "lm"
    start: Literal["current", "chordal"] = "current"
    """Where the poses begin."""
    max_iterations: PositiveInt = 100
    is_robust: bool = True
    """Switchable edges may be switched off."""
    switch_prior: PositiveFloat = 20.0
    """Chi2 at which a switch is one half."""
    kinds: tuple[str, ...] | None = None
    """The kinds of edges that take part; left out, all do."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimizationReport:
    """What came of an optimisation."""

    num_vertices: int
    num_edges: dict[str, int]  # that took part, by kind
    ignored: dict[str, int]  # edges of kinds without a maker, or left out by the config
    error_before: float  # 0.5 chi2, switchable edges with the switches they end with
    error_after: float
    iterations: int
    seconds: float
    switched_off: list[int] = field(default_factory=list)  # rows of edges with a switch below 0.5


def optimize_map(map_: Map, config: OptimizeConfig | None = None) -> tuple[Map, OptimizationReport]:
    """Return the map with the most likely poses and switches, and a report.

    In each part of the map that is connected by edges, the oldest vertex of its first mission stays.

    Raises:
        EstimationError: If the problem has no unique or no finite solution; it names the vertices.
    """
    config = config or OptimizeConfig()
    started = time.perf_counter()
    problem = _Problem(map_, config)
    start = problem.chordal() if config.start == "chordal" else problem.poses
    poses, switches, iterations = problem.solve(start)
    result = _with_solution(map_, poses, switches)
    rows = list(problem.plain) + list(problem.loops)
    kinds, counts = np.unique(map_.edges.kind[rows].astype(str), return_counts=True)
    report = OptimizationReport(
        num_vertices=len(map_.vertices),
        num_edges=dict(zip(kinds.tolist(), counts.tolist(), strict=True)),
        ignored=problem.ignored,
        error_before=problem.error(start, switches),
        error_after=problem.error(poses, switches),
        iterations=iterations,
        seconds=time.perf_counter() - started,
        switched_off=[row for row, switch in switches.items() if switch < 0.5],
    )
    return result, report


class _Problem:
    """The factors of a map; poses are in the map frame, keys are rows of vertices."""

    def __init__(self, map_: Map, config: OptimizeConfig) -> None:
        self.map = map_
        self.config = config
        edges = map_.edges
        self.poses = map_.T_map_base(np.arange(len(map_.vertices)))
        takes_part = np.isin(edges.kind, list(makers()))
        if config.kinds is not None:
            takes_part &= np.isin(edges.kind, config.kinds)
        left_out = edges.kind[~takes_part].astype(str)
        self.ignored = {str(k): int((left_out == k).sum()) for k in np.unique(left_out)}
        factors = make_factors(map_, np.flatnonzero(takes_part), NoiseModels())
        may_switch = edges.is_switchable if config.is_robust else np.zeros(len(edges), bool)
        self.loops = {row: f for row, f in factors.items() if may_switch[row]}
        self.plain = {row: f for row, f in factors.items() if not may_switch[row]}
        anchors = _anchors(map_, np.fromiter(factors, dtype=np.int64))
        self.fixes = [fixed(key, self.poses[key]) for key in anchors]

    def graph(self, prior_weight: float | None) -> Any:  # noqa: ANN401
        """Return gtsam's graph; loops are plain without a prior weight."""
        graph = gtsam.NonlinearFactorGraph()
        for factor in (*self.fixes, *self.plain.values()):
            graph.add(factor)
        for loop in self.loops.values():
            graph.add(loop if prior_weight is None else _switchable_factor(loop, prior_weight))
        return graph

    def chordal(self) -> FloatArray:
        """Return poses by chordal relaxation of the rotations (Carlone et al., ICRA 2015)."""
        alike = gtsam.noiseModel.Isotropic.Sigma(6, 1.0)  # it takes no other kind of noise
        graph = gtsam.NonlinearFactorGraph()
        for factor in (*self.fixes, *self.plain.values(), *self.loops.values()):
            graph.add(factor.cloneWithNewNoiseModel(alike))
        return poses_from(gtsam.InitializePose3.initialize(graph), len(self.poses))

    def chi2(self, loop: Factor, values: Any) -> float:  # noqa: ANN401
        return 2 * float(loop.error(values))

    def solve(self, start: FloatArray) -> tuple[FloatArray, dict[int, float], int]:
        """Return poses, the switch of each loop by row, and the number of iterations."""
        values = values_from(start)
        total = 0
        for prior_weight in self._schedule(values):
            values, iterations = self._descend(self.graph(prior_weight), values)
            total += iterations
        final = self.config.switch_prior
        switches = {row: switch_of(self.chi2(f, values), final) for row, f in self.loops.items()}
        return poses_from(values, len(self.poses)), switches, total

    def _schedule(self, values: Any) -> list[float | None]:  # noqa: ANN401
        """Return the prior weights of the rounds: from nearly convex to the wanted one."""
        if not self.loops:
            return [None]
        worst = max(self.chi2(loop, values) for loop in self.loops.values())
        final = self.config.switch_prior
        rounds = max(0, math.ceil(math.log(max(2 * worst / final, 1), _ANNEALING)))
        return [final * _ANNEALING**k for k in range(rounds, -1, -1)]

    def _descend(self, graph: Any, values: Any) -> tuple[Any, int]:  # noqa: ANN401
        kind = "LevenbergMarquardt" if self.config.solver == "lm" else "Dogleg"
        params = getattr(gtsam, f"{kind}Params")()
        params.setMaxIterations(self.config.max_iterations)
        try:
            optimizer = getattr(gtsam, f"{kind}Optimizer")(graph, values, params)
            result = optimizer.optimize()
        except RuntimeError as error:
            raise EstimationError(describe_failure(error, self.map)) from error
        if not math.isfinite(graph.error(result)):  # gtsam returns without a word after a NaN
            raise EstimationError("the problem has no finite error; look for edges with NaN")
        return result, int(optimizer.iterations())

    def error(self, poses: FloatArray, switches: dict[int, float]) -> float:
        """Return 0.5 chi2, where an edge counts by the square of its switch."""
        values = values_from(poses)
        plain = sum(float(factor.error(values)) for factor in self.plain.values())
        loops = (switches[row] ** 2 * float(f.error(values)) for row, f in self.loops.items())
        return plain + sum(loops)


def _switchable_factor(loop: Factor, prior_weight: float) -> Factor:
    return loop.cloneWithNewNoiseModel(switchable(loop.noiseModel(), prior_weight))


def _anchors(map_: Map, edge_rows: IntArray) -> list[int]:
    """Return a vertex to hold in each connected part: the oldest of its best known mission."""
    from scipy.sparse import coo_array  # noqa: PLC0415  # takes most of a second to import
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    edges, num = map_.edges, len(map_.vertices)
    rows = edge_rows[edges.vertex_b[edge_rows] >= 0]
    links = (np.ones(len(rows)), (edges.vertex_a[rows], edges.vertex_b[rows]))
    _, parts = connected_components(coo_array(links, shape=(num, num)), directed=False)
    unary = edge_rows[edges.vertex_b[edge_rows] < 0]
    held = set(parts[edges.vertex_a[unary]].tolist())
    mission = map_.vertices.mission
    is_guess = ~map_.missions.is_base_frame_known[mission]
    order = np.lexsort((map_.vertices.stamp_ns, mission, is_guess))
    _, first = np.unique(parts[order], return_index=True)
    return [int(v) for v in sorted(order[first].tolist()) if parts[v] not in held]


def _with_solution(map_: Map, poses: FloatArray, switches: dict[int, float]) -> Map:
    """Return the map with new poses and switches."""
    map_ = with_solution(map_, values_from(poses))
    switch = map_.edges.switch.copy()
    switch[list(switches)] = list(switches.values())
    return replace(map_, edges=replace(map_.edges, switch=switch))


def describe_failure(error: RuntimeError, map_: Map) -> str:
    """Return what gtsam could not solve, in terms of the map."""
    found = re.search(r"(?:variable|Symbol:|key)\D*(\d+)", str(error))
    if found is None or int(found[1]) >= len(map_.vertices):
        return f"the problem cannot be solved: {str(error).strip()}"
    key = int(found[1])
    mission = map_.mission_id(int(map_.vertices.mission[key]))
    stamp_ns = int(map_.vertices.stamp_ns[key])
    return (
        f"the pose at {stamp_ns} ns of mission {mission} (vertex {key}) is not determined by the edges;"
        " look for an edge without covariance in some direction, or add an absolute edge"
    )
