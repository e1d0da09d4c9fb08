"""The normal equations of a bundle and the rest of a map's problem together, in columns of gtsam's keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from mapstream.operators.estimation.solvers import Graph
from mapstream.operators.estimation.states import Values
from mapstream.operators.estimation.vision.bundle import Bundle
from mapstream.operators.estimation.vision.bundle_state import (
    all_errors,
    linearized,
    plausible,
    state_of,
)
from mapstream.operators.estimation.vision.schur import Blocks, Eliminated, Pairs, eliminate
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from scipy.sparse import csc_array

_EXACT_SIGMA = 1e-6  # of what is held; a normal matrix has no hard constraints


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
