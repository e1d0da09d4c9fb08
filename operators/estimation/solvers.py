"""The solver behind an interface: a graph and a start go in, the minimum and how it was reached come out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gtsam

from mapstream.operators.estimation.states import Values

Graph = Any  # gtsam has no types
_RELATIVE_TOLERANCE = 1e-5  # of the error, between two iterations; gtsam's own default
_ABSOLUTE_TOLERANCE = 1e-5
_MAX_LAMBDA = 1e5  # gtsam gives up there


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """When a solver stops although it is not done."""

    max_iterations: int = 100
    end_s: float = math.inf  # on `time.perf_counter`
    initial_lambda: float = 1e-5  # of Levenberg-Marquardt


@dataclass(frozen=True, slots=True, kw_only=True)
class Solved:
    """Where a solver ended."""

    values: Values
    error: float  # 0.5 chi2 with its losses; not finite where the problem is not
    iterations: int
    is_converged: bool  # or a cap was hit
    final_lambda: float  # the damping with which a similar problem should begin


Solver = Callable[[Graph, Values, Limits], Solved]


def levenberg_marquardt(graph: Graph, values: Values, limits: Limits) -> Solved:
    """Minimise with gtsam's Levenberg-Marquardt.

    Raises:
        RuntimeError: If a variable is not determined, as gtsam says it.
    """
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(limits.max_iterations)
    params.setlambdaInitial(min(limits.initial_lambda, _MAX_LAMBDA))
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    return _iterate(optimizer, limits)


def dogleg(graph: Graph, values: Values, limits: Limits) -> Solved:
    """Minimise with gtsam's Powell dogleg.

    Raises:
        RuntimeError: If a variable is not determined, as gtsam says it.
    """
    params = gtsam.DoglegParams()
    params.setMaxIterations(limits.max_iterations)
    return _iterate(gtsam.DoglegOptimizer(graph, values, params), limits)


def _iterate(optimizer: Any, limits: Limits) -> Solved:  # noqa: ANN401
    """Take steps until the error stands still; gtsam's own loop knows no time."""
    error, is_converged = float(optimizer.error()), False
    while not is_converged and math.isfinite(error):
        if optimizer.iterations() >= limits.max_iterations or time.perf_counter() > limits.end_s:
            break
        optimizer.iterate()
        before, error = error, float(optimizer.error())
        fell = before - error
        is_converged = fell <= _ABSOLUTE_TOLERANCE or fell <= _RELATIVE_TOLERANCE * before
    return Solved(
        values=optimizer.values(),
        error=error,
        iterations=int(optimizer.iterations()),
        is_converged=is_converged,
        final_lambda=_lambda_of(optimizer, limits),
    )


def _lambda_of(optimizer: Any, limits: Limits) -> float:  # noqa: ANN401
    has_lambda = isinstance(optimizer, gtsam.LevenbergMarquardtOptimizer)
    return float(optimizer.lambda_()) if has_lambda else limits.initial_lambda
