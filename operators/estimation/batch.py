"""The whole map as one problem, in one batch: every kind of variable and edge takes part.

A solution that explains its measurements by chance is accepted as it is. One that does not is a local minimum, or
false loops pull at it: then other starts are tried, and loops are switched off (`robust.py`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from mapstream.operators.estimation.determinacy import determined
from mapstream.operators.estimation.factors.inertial import outdated
from mapstream.operators.estimation.noise import Factor
from mapstream.operators.estimation.optimize_config import OptimizeConfig
from mapstream.operators.estimation.outliers.fix_judge import without_false_fixes
from mapstream.operators.estimation.outliers.robust import Descent, RobustSolution
from mapstream.operators.estimation.problem import (
    Problem,
    describe_failure,
    graph_of,
    make_problem,
)
from mapstream.operators.estimation.report import (
    KindReport,
    OptimizationReport,
    as_one,
    dropped_edges,
)
from mapstream.operators.estimation.solvers import Limits, Solver, dogleg, levenberg_marquardt
from mapstream.operators.estimation.sparse_solver import sparse_levenberg_marquardt
from mapstream.operators.estimation.starts.landmark_starts import averaged_landmarks
from mapstream.operators.estimation.starts.start import chordal_values
from mapstream.operators.estimation.states import Values, with_solution
from mapstream.operators.estimation.vision.bundle import FAMILIES
from mapstream.operators.estimation.vision.bundle_solver import bundle_solver
from mapstream.operators.estimation.vision.judging import judged, without_outliers
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray
from mapstream.streams.errors import EstimationError

__all__ = ["OptimizationReport", "OptimizeConfig", "optimize_map"]

_MOST_INTEGRATIONS = 4  # of IMU samples, as long as the biases move


SOLVERS: dict[str, Solver] = {
    "lm": levenberg_marquardt,
    "dogleg": dogleg,
    "sparse": sparse_levenberg_marquardt,
}


def optimize_map(map_: Map, config: OptimizeConfig | None = None) -> tuple[Map, OptimizationReport]:
    """Return the map with the most likely state and switches, and a report.

    In each part of the map that is connected by edges, the oldest vertex of its best known mission stays, unless
    measurements in the map's frame say where the part is.

    Raises:
        EstimationError: If the edges do not determine the state, unless priors shall; it names the variables.
            If they have no finite solution.
    """
    config = config or OptimizeConfig()
    started = time.perf_counter()
    if config.start_landmarks == "mean":
        map_ = averaged_landmarks(map_)
    rejected: list[int] = []
    if config.reject_absolute:
        map_, rejection = without_false_fixes(map_)
        rejected = rejection.rejected
    result, report, plain = _round(map_, config, started)
    for _ in range(_MOST_INTEGRATIONS - 1):
        if not outdated(result, plain):
            break
        before = report
        result, report, plain = _round(result, config, started)
        report = as_one(before, report)
    return result, replace(report, rejected_absolute=rejected)


def _round(
    map_: Map, config: OptimizeConfig, started: float
) -> tuple[Map, OptimizationReport, Mapping[int, Factor]]:
    """Return the solution for IMU samples integrated with the biases of now, a report, and its factors."""
    problem = determined(make_problem(map_, config), config.underconstrained)
    try:
        best = _solve(problem, config, started)
    except RuntimeError as error:
        raise EstimationError(describe_failure(error, map_)) from error
    report = replace(_report(problem, best, config), seconds=time.perf_counter() - started)
    return _result(problem, best, config), report, problem.plain


def _solve(problem: Problem, config: OptimizeConfig, started: float) -> RobustSolution:
    """Return the best solution of the starts that are worth trying."""
    end_s = started + config.max_seconds if config.max_seconds else math.inf
    limits = Limits(
        max_iterations=config.max_iterations, end_s=end_s, initial_lambda=config.initial_lambda
    )
    descent = Descent(problem, config.gate_probability, _solver(problem, config), limits)
    starts = {"auto": ("current", "chordal")}.get(config.start, (config.start,))
    if not descent.contradicts_odometry():
        tried = []
        for start in starts:
            tried.append(descent.plain(_values(problem, start, descent.may_be_true), start))
            if descent.is_by_chance(tried[-1]):
                return tried[-1]
        if not problem.loops:
            return min(tried, key=lambda each: each.cost)
    found = []
    for start in starts:
        found.append(descent.switched(_values(problem, start, descent.may_be_true), start))
        if descent.is_likely(found[-1]):
            break
    return min(found, key=lambda each: each.cost)


def _solver(problem: Problem, config: OptimizeConfig) -> Solver:
    """Return the solver that the config asks for, with the bundle if there is one.

    Raises:
        EstimationError: If it has no place for observations.
    """
    if not problem.bundle:
        return SOLVERS[config.solver]
    if config.solver != "lm":
        families = ", ".join(FAMILIES)
        raise EstimationError(
            f"solver {config.solver} takes no observations; set without to {families}, or solver: lm"
        )
    return bundle_solver(problem.bundle)


def _values(problem: Problem, start: str, loops: BoolArray) -> Values:
    if start == "current":
        return problem.values
    rows = np.fromiter(problem.loops, dtype=np.int64)
    return chordal_values(problem, rows[loops])


def _result(problem: Problem, best: RobustSolution, config: OptimizeConfig) -> Map:
    """Return the map with the new state, and switches with what is known of them."""
    map_ = with_solution(problem.map, best.values, held=problem.fixed, fix=config.fix)
    if problem.bundle:
        map_ = without_outliers(map_, problem.bundle, best.values)
    switch, variance = map_.edges.switch.copy(), map_.edges.switch_variance.copy()
    rows = list(problem.loops)
    switch[rows] = best.is_true
    variance[rows] = 1 / (best.gate + best.chi2)  # Laplace's, of gate (1 - s)^2 + s^2 chi2
    return replace(map_, edges=replace(map_.edges, switch=switch, switch_variance=variance))


def _report(problem: Problem, best: RobustSolution, config: OptimizeConfig) -> OptimizationReport:
    rows = np.fromiter(problem.loops, dtype=np.int64)
    true = set(rows[best.is_true].tolist())
    kinds = _kinds(problem, true, best.values)
    left_out = 0
    if problem.bundle:
        families, left_out = judged(problem.bundle, problem.values, best.values)
        kinds |= families
    off = dict(zip(rows[~best.is_true].tolist(), best.chi2[~best.is_true].tolist(), strict=True))
    return OptimizationReport(
        num_vertices=len(problem.map.vertices),
        num_edges=problem.num_edges,
        num_outliers=left_out,
        ignored=problem.ignored,
        error_before=0.5 * sum(kind.chi2_before for kind in kinds.values()),
        error_after=0.5 * sum(kind.chi2_after for kind in kinds.values()),
        iterations=best.iterations,
        seconds=0.0,
        start=best.start,
        solver=config.solver,
        kinds=kinds,
        switched_off=list(off),
        dropped=dropped_edges(problem.map, off),
        underconstrained=problem.underconstrained,
        is_converged=best.is_converged,
        final_lambda=best.final_lambda,
    )


def _kinds(problem: Problem, true: set[int], values: Values) -> dict[str, KindReport]:
    by_kind: dict[str, list[Factor]] = {}
    kinds = problem.map.edges.kind
    for row, factor in problem.plain.items():
        by_kind.setdefault(kinds[row], []).append(factor)
    for row, factor in problem.loops.items():
        found = by_kind.setdefault(kinds[row], [])
        if row in true:
            found.append(factor)
    counts, graphs = problem.num_edges, {kind: graph_of(by_kind[kind]) for kind in sorted(by_kind)}
    return {
        kind: KindReport(
            count=counts[kind],
            chi2_before=2 * float(graph.error(problem.values)),
            chi2_after=2 * float(graph.error(values)),
        )
        for kind, graph in graphs.items()
    }
