"""Loops that contradict the rest, found and switched off.

Geman-McClure is the switchable constraint of Suenderhauf and Protzel (IROS 2012) with the switch eliminated.
It finds the basin, from odometry and the loops that agree with it; then truncated least squares decides: a loop
is true, and counts in full, or false. Its cost, `sum of min(chi2, gate)`, chooses between solutions.
Sources: Black and Rangarajan, IJCV 1996; Yang et al., RA-L 2020; Mangelson et al., ICRA 2018.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from mapstream.operators.estimation.noise import Factor, switchable
from mapstream.operators.estimation.outliers.consistency import chi2_gate, cycle_chi2
from mapstream.operators.estimation.problem import Problem, chi2_of, dimensions
from mapstream.operators.estimation.solvers import Graph, Limits, Solved, Solver
from mapstream.operators.estimation.states import Values
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.errors import EstimationError

_NEGLIGIBLE = 100.0  # gates: beyond, a loop hardly pulls, and only fills the matrix
_WIDENINGS = (64.0, 16.0, 4.0)  # of the gate: lets true loops back in that the first solution lost
_SECOND_CHANCES = 0.1  # of the loops found true, for as many others that are least false
_FEW = 10  # loops always get one
_NO_BETTER = 1e-6
_LIKELY = 0.5  # of the loops that agree with odometry; where fewer are true, the start was bad
_MAX_ROUNDS = 20
_UNLUCKY = 5.0  # standard deviations of chi2 above its mean that chance explains
_ROUND_ITERATIONS = 3  # of a round; the loops that take part change between rounds


@dataclass(frozen=True, slots=True, kw_only=True)
class RobustSolution:
    """A state, and which loops are true."""

    values: Values
    start: str  # what it was reached from
    is_true: BoolArray  # (num_loops,)
    chi2: FloatArray  # (num_loops,) of each loop, true or not
    gate: FloatArray  # (num_loops,) above which it is false
    cost: float  # 0.5 of the truncated squares
    iterations: int
    is_converged: bool
    final_lambda: float


class Descent:
    """Ways down from a start, for one problem."""

    def __init__(
        self, problem: Problem, probability: float, solver: Solver, limits: Limits
    ) -> None:
        self._problem, self._solver, self._limits = problem, solver, limits
        self._loops: list[Factor] = list(problem.loops.values())
        self._gate = chi2_gate(dimensions(problem.loops, problem.map), probability)
        self._iterations = 0
        rows = np.fromiter(problem.loops, dtype=np.int64)
        cycle = cycle_chi2(problem.map, rows) if len(rows) else np.zeros(0)
        self._is_untested: BoolArray = np.isnan(cycle)  # between missions, for instance
        self.may_be_true: BoolArray = ~(cycle > self._gate)  # NaN: odometry does not say

    def contradicts_odometry(self) -> bool:
        """Return whether a loop is false, or odometry worse than it says."""
        return not self.may_be_true.all()

    def plain(self, values: Values, start: str) -> RobustSolution:
        """Return the minimum with every loop as true."""
        solved = self._solve(self._problem.whole_graph(), values, self._limits.max_iterations)
        everything = np.ones(len(self._loops), dtype=bool)
        return self._solution(solved, start, everything)

    def is_by_chance(self, solution: RobustSolution) -> bool:
        """Return whether noise alone explains what the solution leaves over."""
        freedom = self._problem.freedom
        limit = freedom + _UNLUCKY * np.sqrt(2 * freedom)
        return bool((solution.chi2 <= self._gate).all() and 2 * solution.cost <= limit)

    def switched(self, values: Values, start: str) -> RobustSolution:
        """Return the minimum with the loops that are true."""
        best = self._decided(self._softened(values, 1.0, self.may_be_true), start)
        for widening in _WIDENINGS:
            again = self._decided(
                self._softened(best.values, widening, self._plausible(best)), start
            )
            if again.cost >= best.cost * (1 - _NO_BETTER):
                break
            best = again
        return best

    def is_likely(self, solution: RobustSolution) -> bool:
        """Return whether most of the loops that agree with odometry were found true."""
        return int(solution.is_true.sum()) > _LIKELY * int(self.may_be_true.sum())

    def _plausible(self, solution: RobustSolution) -> BoolArray:
        """Return the loops that are true, and some that are least false: each that joins fills the matrix."""
        excess = np.where(solution.is_true | ~self.may_be_true, np.inf, solution.chi2 / self._gate)
        count = max(_FEW, int(_SECOND_CHANCES * solution.is_true.sum()))
        plausible = solution.is_true.copy()
        plausible[np.argsort(excess, kind="stable")[:count]] = True
        return (plausible | self._is_untested) & self.may_be_true

    def _softened(self, start: Values, widening: float, candidates: BoolArray) -> Values:
        """Return the minimum of the Geman-McClure cost over the candidates."""
        width = widening * self._gate
        softened = [
            loop.cloneWithNewNoiseModel(switchable(loop.noiseModel(), phi))
            for loop, phi in zip(self._loops, width.tolist(), strict=True)
        ]
        reach = _NEGLIGIBLE * np.where(self._is_untested, width, self._gate)
        values, before = start, np.zeros(0, dtype=bool)
        for _ in range(_MAX_ROUNDS):
            near = candidates & (self._chi2(values) < reach)
            graph = self._with([softened[k] for k in np.flatnonzero(near).tolist()])
            solved = self._solve(graph, values, _ROUND_ITERATIONS)
            values = solved.values
            if self._is_late() or (solved.is_converged and np.array_equal(near, before)):
                break
            before = near
        return values

    def _decided(self, values: Values, start: str) -> RobustSolution:
        """Return the minimum where each loop counts in full or, beyond the gate, not at all."""
        is_true = self._chi2(values) < self._gate
        rounds = 0
        while True:
            graph = self._with([self._loops[k] for k in np.flatnonzero(is_true).tolist()])
            solved = self._solve(graph, values, self._limits.max_iterations)
            solution, rounds = self._solution(solved, start, is_true), rounds + 1
            values, is_true = solved.values, solution.chi2 < self._gate
            is_over = self._is_late() or rounds == _MAX_ROUNDS
            if is_over or np.array_equal(is_true, solution.is_true):
                return solution

    def _solution(self, solved: Solved, start: str, is_true: BoolArray) -> RobustSolution:
        return RobustSolution(
            values=solved.values,
            start=start,
            is_true=is_true,
            chi2=self._chi2(solved.values),
            gate=self._gate,
            cost=solved.error + 0.5 * float(self._gate[~is_true].sum()),
            iterations=self._iterations,
            is_converged=solved.is_converged,
            final_lambda=solved.final_lambda,
        )

    def _chi2(self, values: Values) -> FloatArray:
        return chi2_of(self._problem.loops, values)

    def _with(self, loops: list[Factor]) -> Graph:
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(self._problem.base_graph)
        for loop in loops:
            graph.add(loop)
        return graph

    def _solve(self, graph: Graph, values: Values, most: int) -> Solved:
        """Go down, and count.

        Raises:
            EstimationError: If the problem has no finite error.
        """
        solved = self._solver(graph, values, replace(self._limits, max_iterations=most))
        if not math.isfinite(solved.error):  # gtsam returns without a word after a NaN
            raise EstimationError("the problem has no finite error; look for edges with NaN")
        self._iterations += solved.iterations
        return solved

    def _is_late(self) -> bool:
        return time.perf_counter() > self._limits.end_s
