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
from typing import TYPE_CHECKING

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
from mapstream.operators.estimation.vision.schur import Blocks, Eliminated, Pairs, eliminate
from mapstream.recordings.maps.columns import BoolArray
from mapstream.streams.arrays import FloatArray, IntArray

if TYPE_CHECKING:
    from scipy.sparse import csc_array

_RELATIVE_TOLERANCE = 1e-6  # of the error, between two iterations
_ABSOLUTE_TOLERANCE = 1e-8
_MAX_LAMBDA = 1e10
_MIN_LAMBDA = 1e-10
_CHECK_EVERY = 3  # iterations: which observations take part (maplab)
_EXACT_SIGMA = 1e-6  # of what is held; a normal matrix has no hard constraints
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


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """The normal equations at a point, with and without the bundle's points."""

    rest: csc_array  # J^T J of the graph
    rest_gradient: FloatArray
    blocks: Blocks


class Columns:
    """The columns of the normal equations: variables in order of their keys, those of points only if they are in the graph."""

    def __init__(self, bundle: Bundle, graph: Graph, values: Values) -> None:
        in_graph = set(graph.keyVector())
        keys = bundle.point_keys
        self.is_kept: BoolArray = np.array([key in in_graph for key in keys], bool)
        self.own_points = [
            k for k, kept in zip(keys, self.is_kept.tolist(), strict=True) if not kept
        ]
        self.values = gtsam.Values(values)
        for key in self.own_points:
            self.values.erase(key)
        zeros = self.values.zeroVectors()
        self.keys = sorted(self.values.keys())
        self.sizes = [zeros.at(key).size for key in self.keys]
        starts = np.cumsum([0, *self.sizes])
        self.num = int(starts[-1])
        start_of = dict(zip(self.keys, starts[:-1].tolist(), strict=True))
        self.start_of = start_of
        poses = np.array([start_of[row] for row in bundle.vertices.tolist()], np.int64)
        extra = [
            np.arange(start_of[key], start_of[key] + zeros.at(key).size)
            for sensor in bundle.sensors
            for key in sensor.keys
        ]
        self.bundle: IntArray = np.concatenate([(poses[:, None] + np.arange(6)).ravel(), *extra])
        kept = [start_of[k] for k, is_kept in zip(keys, self.is_kept.tolist(), strict=True) if is_kept]  # fmt: skip
        self.kept: IntArray = np.array(kept, np.int64)

    def of_graph(self, keys: list[int]) -> IntArray:
        """Return the columns of some variables, one after another."""
        sizes = dict(zip(self.keys, self.sizes, strict=True))
        spans = [np.arange(self.start_of[k], self.start_of[k] + sizes[k]) for k in keys]
        return np.concatenate([np.zeros(0, np.int64), *spans])

    def moved(self, values: Values, step: FloatArray) -> Values:
        """Return the values after a step."""
        delta = gtsam.VectorValues()
        for key, size in zip(self.keys, self.sizes, strict=True):
            start = self.start_of[key]
            delta.insert(key, step[start : start + size])
        return values.retract(delta)


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


def reduced_normal(bundle: Bundle, graph: Graph, values: Values) -> tuple[csc_array, Columns]:
    """Return the normal matrix of a graph and a bundle, without the points that only the bundle has."""
    columns = Columns(bundle, graph, values)
    state = state_of(bundle, values)
    soft = softened(graph)
    rest, gradient = graph_normal(
        soft, columns.values, columns.of_graph(sorted(soft.keys())), columns.num
    )
    used = plausible(bundle, all_errors(bundle, state))
    linear = Linear(rest, gradient, linearized(bundle, state, used))
    left = eliminate(bundle.pairs, linear.blocks, 0.0, columns.is_kept | bundle.points_stay)
    return joined(linear, left, columns, bundle.pairs)[0], columns


def joined(
    linear: Linear,
    left: Eliminated,
    columns: Columns,
    pairs: Pairs,
) -> tuple[csc_array, FloatArray]:
    """Return the normal equations of all columns; points that the graph has as well stay among them."""
    from scipy.sparse import coo_array  # noqa: PLC0415

    at, gradient = columns.bundle, linear.rest_gradient.copy()
    part = left.normal.tocoo()
    entries, rows, cols = [part.data], [at[part.row]], [at[part.col]]
    np.add.at(gradient, at, left.gradient)
    if len(columns.kept):
        where = np.full(len(columns.is_kept), -1)
        where[columns.is_kept] = columns.kept
        blocks = linear.blocks
        own = where[columns.is_kept][:, None] + np.arange(3)
        gradient[own] += blocks.point_gradient[columns.is_kept]
        seen = np.flatnonzero(where[pairs.point] >= 0)
        by_pose = where[pairs.point[seen]][:, None] + np.arange(3)
        poses = at[6 * pairs.pose[seen][:, None] + np.arange(6)]
        extra = np.broadcast_to(at[6 * pairs.num_poses :], (len(own), left.extra.shape[2]))
        for block, first, second in (
            (blocks.point[columns.is_kept], own, own),
            (blocks.cross[seen], by_pose, poses),
            (blocks.point_extra[columns.is_kept], own, extra),
        ):
            r, c = np.broadcast_arrays(first[:, :, None], second[:, None, :])
            entries.append(block.ravel())
            rows.append(r.ravel())
            cols.append(c.ravel())
            if second is not own:
                entries.append(block.ravel())
                rows.append(c.ravel())
                cols.append(r.ravel())
    places = (np.concatenate(rows), np.concatenate(cols))
    own_part = coo_array((np.concatenate(entries), places), shape=(columns.num,) * 2)
    return (linear.rest + own_part.tocsc()).tocsc(), gradient


def graph_normal(
    graph: Graph, values: Values, columns: IntArray, num: int
) -> tuple[csc_array, FloatArray]:
    """Return J^T J (num, num) and the gradient (num,) of gtsam's factors, whose variables have these columns."""
    from scipy.sparse import coo_array, csc_array  # noqa: PLC0415

    if graph.size() == 0:
        return csc_array((num, num)), np.zeros(num)
    rows, cols, entries = graph.linearize(values).sparseJacobian_()
    r, c = rows.astype(np.int64) - 1, cols.astype(np.int64) - 1
    is_left = c < len(columns)  # the last column is the right side
    size = int(r.max(initial=0)) + 1
    J = coo_array((entries[is_left], (r[is_left], columns[c[is_left]])), shape=(size, num)).tocsc()
    right = np.zeros(size)
    right[r[~is_left]] = entries[~is_left]
    return (J.T @ J).tocsc(), -(J.T @ right)


def softened(graph: Graph) -> Graph:
    """Return the graph with what it holds exactly held very tightly."""
    soft = gtsam.NonlinearFactorGraph()
    for at in range(graph.size()):
        factor = graph.at(at)
        noise = factor.noiseModel()
        if noise.isConstrained():
            tight = gtsam.noiseModel.Isotropic.Sigma(noise.dim(), _EXACT_SIGMA)
            factor = factor.cloneWithNewNoiseModel(tight)
        soft.add(factor)
    return soft


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
