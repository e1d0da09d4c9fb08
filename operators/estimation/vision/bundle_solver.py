"""Levenberg-Marquardt on a bundle and the rest of the map's problem together.

gtsam linearises the rest; the points of the bundle are eliminated in NumPy, all at once. One factor object per
observation would cost more than everything else (docs/decisions/0010-bundle-adjustment.md).
Source: Marquardt, SIAM 1963; Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from mapstream.operators.estimation.keys import key_of, variable_of
from mapstream.operators.estimation.solvers import Graph, Limits, Solved, Solver
from mapstream.operators.estimation.states import Values, poses_at
from mapstream.operators.estimation.vision.bundle import Bundle
from mapstream.operators.estimation.vision.bundle_state import (
    State,
    Used,
    all_errors,
    chi2_by_family,
    linearized,
    plausible,
    state_of,
)
from mapstream.operators.estimation.vision.normal_equations import (
    Columns,
    Linear,
    graph_normal,
    joined,
    softened,
)
from mapstream.operators.estimation.vision.schur import Blocks, eliminate
from mapstream.streams.arrays import FloatArray

_RELATIVE_TOLERANCE = 1e-6  # of the error, between two iterations
_ABSOLUTE_TOLERANCE = 1e-8
_MAX_LAMBDA = 1e10
_MIN_LAMBDA = 1e-10
_CHECK_EVERY = 3  # iterations: which observations take part (maplab)
_LEAST = 1e-9  # that the diagonal counts as in the damping


def bundle_solver(bundle: Bundle) -> Solver:
    """Return the solver of a graph together with a bundle; its values hold the bundle's points, too."""

    def solve(graph: Graph, values: Values, limits: Limits) -> Solved:
        return _Descent(bundle, graph, values).run(limits)

    return solve


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """Where the descent is."""

    values: Values  # without the points that are eliminated
    state: State
    error: float


class _Descent:
    def __init__(self, bundle: Bundle, graph: Graph, values: Values) -> None:
        self.bundle = bundle
        self.graph = softened(graph)
        self.columns = Columns(bundle, graph, values)
        self.stays = self.columns.is_kept | bundle.points_stay
        self.graph_columns = self.columns.of_graph(sorted(self.graph.keys()))
        self.used: Used = ()
        self.start = state_of(bundle, values)

    def run(self, limits: Limits) -> Solved:
        """Go down until the error stands still and the same observations take part."""
        here = self._checked(_Point(self.columns.values, self.start, math.inf))
        damping, iterations, is_converged = max(limits.initial_lambda, _MIN_LAMBDA), 0, False
        while math.isfinite(here.error) and iterations < limits.max_iterations:
            if time.perf_counter() > limits.end_s:
                break
            iterations += 1
            there, damping = self._stepped(here, damping)
            stands = _stands(here.error, there.error)
            here = there
            if stands or iterations % _CHECK_EVERY == 0:
                used, before = self.used, here.error
                here = self._checked(here)
                same = all(map(np.array_equal, used, self.used))
                damping = damping if same else limits.initial_lambda  # of another problem
                is_converged = stands and same and _stands(before, here.error)
            if is_converged:
                break
        return Solved(
            values=self._with_points(here),
            error=here.error,
            iterations=iterations,
            is_converged=is_converged,
            final_lambda=damping,
        )

    def _checked(self, here: _Point) -> _Point:
        """Return the same place after a look at when and by whom points were seen."""
        self.bundle = refreshed(self.bundle, here.values, here.state)
        found = all_errors(self.bundle, here.state)
        self.used = plausible(self.bundle, found)
        return replace(here, error=self._error(here.values, found))

    def _error(self, values: Values, found: Sequence[FloatArray]) -> float:
        bundle = sum(chi2_by_family(self.bundle, found, self.used).values())
        return float(self.graph.error(values)) + 0.5 * bundle

    def _stepped(self, here: _Point, damping: float) -> tuple[_Point, float]:
        """Return the next place, which is the same where no step leads down, and the next damping."""
        linear = self._linearized(here)
        while damping <= _MAX_LAMBDA:
            step, points = self._step(linear, damping)
            values = self.columns.moved(here.values, step)
            moved = here.state.points + points
            kept = self.columns.is_kept
            if kept.any():
                rows = self.bundle.landmarks[kept].tolist()
                moved[kept] = [values.atPoint3(key_of("landmark", row)) for row in rows]
            state = state_of(self.bundle, values, moved)
            error = self._error(values, all_errors(self.bundle, state))
            if error <= here.error:
                return _Point(values, state, error), max(damping / 10, _MIN_LAMBDA)
            damping *= 10
        return here, damping

    def _linearized(self, here: _Point) -> Linear:
        rest, gradient = graph_normal(self.graph, here.values, self.graph_columns, self.columns.num)
        return Linear(rest, gradient, linearized(self.bundle, here.state, self.used))

    def _step(self, linear: Linear, damping: float) -> tuple[FloatArray, FloatArray]:
        """Return the step of all columns, and of the points (L, 3).

        Raises:
            RuntimeError: If the equations are singular even with the damping.
        """
        from scipy.sparse import diags_array  # noqa: PLC0415  # takes most of a second to import
        from scipy.sparse.linalg import splu  # noqa: PLC0415

        pairs = self.bundle.pairs
        left = eliminate(pairs, linear.blocks, damping, self.stays)
        normal, gradient = joined(linear, left, self.columns, pairs)
        diagonal = linear.rest.diagonal()
        np.add.at(diagonal, self.columns.bundle, _diagonal(linear.blocks))
        damped = (normal + diags_array(damping * np.maximum(diagonal, _LEAST))).tocsc()
        factors = splu(damped, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})  # fmt: skip
        step: FloatArray = factors.solve(-gradient)
        return step, left.points(pairs, step[self.columns.bundle])

    def _with_points(self, here: _Point) -> Values:
        values = gtsam.Values(here.values)
        own = here.state.points[~self.columns.is_kept]
        for key, point in zip(self.columns.own_points, own, strict=True):
            values.insertPoint3(key, point)
        return values


def refreshed(bundle: Bundle, values: Values, state: State) -> Bundle:
    """Return the bundle with the robot's motion of now around the times of its observations."""
    if bundle.motion is None:
        return bundle
    present = sorted(key for key in values.keys() if variable_of(key)[0] == "pose")  # noqa: SIM118  # gtsam's
    rows = np.array(present, np.int64)
    poses, velocities = bundle.motion.poses.copy(), bundle.motion.velocities.copy()
    poses[rows] = poses_at(values, rows)
    turn = poses[:, :3, :3] @ np.swapaxes(bundle.motion.poses[:, :3, :3], 1, 2)
    velocities = np.einsum("nij,nj->ni", turn, velocities)
    for row in present:
        key = key_of("velocity", row)
        if values.exists(key):
            velocities[row] = values.atVector(key)
    motion = replace(bundle.motion, poses=poses, velocities=velocities)
    return bundle.moved(motion, [sensor.time_offset_s for sensor in state.sensors])


def _stands(before: float, after: float) -> bool:
    return abs(before - after) <= _ABSOLUTE_TOLERANCE + _RELATIVE_TOLERANCE * before


def _diagonal(blocks: Blocks) -> FloatArray:
    poses = np.diagonal(blocks.pose, axis1=1, axis2=2).ravel()
    return np.concatenate([poses, np.diagonal(blocks.extra)])
