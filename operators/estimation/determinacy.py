"""Variables that the edges leave open, found before a solver stumbles over them, or hides them by its damping.

A direction in which no residual changes is a null vector of the normal matrix. Power iteration on its inverse
finds these, and the variables that move along them are named.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import gtsam
import numpy as np

from mapstream.operators.estimation.factors.landmarks import shape_of
from mapstream.operators.estimation.fixing import fixes
from mapstream.operators.estimation.keys import variable_of
from mapstream.operators.estimation.noise import Factor
from mapstream.operators.estimation.problem import Problem, describe_variable, graph_of
from mapstream.operators.estimation.vision.normal_equations import reduced_normal
from mapstream.operators.odometry.uncertainty import is_whole
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import EstimationError

if TYPE_CHECKING:
    from scipy.sparse import csc_array

_NULL = 1e-12  # curvature, where that along each variable alone is one
_SHARE = 0.05  # of a null vector's largest part; smaller ones are rounding
_MAX_DIRECTIONS = 8  # each is a mixture of all that are open, so that few name every variable
_ITERATIONS = 3
_SHIFT = 1e-14  # makes the inverse exist
_NAMED = 5  # in an error
_WEAK_SIGMA = 1e3  # rad, m, m/s: of the prior that holds what is open
_SIZES = {"pose": 6, "plane": 3, "point": 3, "point2d": 2}
_FULL_KINDS = frozenset({"odometry", "registration", "motion_model", "loop", "absolute", "fixed"})


def determined(problem: Problem, policy: Literal["error", "prior"]) -> Problem:
    """Return a problem in which every variable is determined, by a weak prior on those that were not.

    Raises:
        EstimationError: If variables are open and the policy is error; it names them.
    """
    keys = open_variables(problem)
    if not keys:
        return problem
    names = [describe_variable(key, problem.map) for key in keys]
    if policy == "error":
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        raise EstimationError(
            f"{'; '.join(names[:_NAMED])}{more}: not determined by the edges; look for edges that left a"
            " direction unmeasured, add an absolute edge, or set underconstrained: prior"
        )
    held = [*problem.held, *_weak(problem, keys)]
    return replace(
        problem,
        held=held,
        base_graph=graph_of([*held, *problem.plain.values()]),
        underconstrained=names,
    )


def open_variables(problem: Problem) -> list[int]:
    """Return the keys of variables that can move without any residual changing."""
    if problem.bundle:
        normal, owner = bundle_normal(problem)
    elif _is_full(problem):
        return []
    else:
        normal, owner = _normal_matrix(problem)
    found: set[int] = set()
    for vector in np.abs(_null_vectors(normal)):
        found.update(owner[vector > _SHARE * vector.max()].tolist())
    return sorted(found)


def _is_full(problem: Problem) -> bool:
    """Return whether all edges measure all six directions: then what is connected is determined."""
    edges = problem.map.edges
    rows = np.array([*problem.plain, *problem.loops], dtype=np.int64)
    is_measured = is_whole(edges.covariance[rows]).all()
    return bool(is_measured) and set(edges.kind[rows]) <= _FULL_KINDS


def _normal_matrix(problem: Problem) -> tuple[csc_array, IntArray]:
    """Return J^T J with a unit diagonal, and the key of each column; a column of zeros stays one."""
    from scipy import sparse  # noqa: PLC0415  # takes most of a second to import

    keys = sorted(problem.values.keys())
    owner = np.repeat(keys, [_size(problem, key) for key in keys])
    rows, columns, entries = problem.whole_graph().linearize(problem.values).sparseJacobian_()
    is_left = columns <= len(owner)  # the last column is the right side
    places = (rows[is_left].astype(np.int64) - 1, columns[is_left].astype(np.int64) - 1)
    shape = (int(rows.max(initial=1)), len(owner))
    jacobian = sparse.coo_array((entries[is_left], places), shape=shape).tocsc()
    length = np.sqrt((jacobian**2).sum(axis=0))
    unit = jacobian @ sparse.diags_array(1 / np.where(length > 0, length, 1.0))
    return (unit.T @ unit).tocsc(), owner


def bundle_normal(problem: Problem) -> tuple[csc_array, IntArray]:
    """Return the same for a problem with a bundle, whose points are eliminated."""
    from scipy import sparse  # noqa: PLC0415

    normal, columns = reduced_normal(problem.bundle, problem.whole_graph(), problem.values)
    owner = np.repeat(columns.keys, columns.sizes)
    length = np.sqrt(normal.diagonal())
    scale = sparse.diags_array(1 / np.where(length > 0, length, 1.0))
    return (scale @ normal @ scale).tocsc(), owner


def _size(problem: Problem, key: int) -> int:
    variable, row = variable_of(key)
    if variable == "landmark":
        return _SIZES[shape_of(problem.map.landmarks.kind[row])]
    if variable in ("intrinsics", "time_offset"):
        return len(problem.values.atVector(key))
    return 3 if variable == "velocity" else 6


def _null_vectors(normal: csc_array) -> FloatArray:
    """Return orthogonal directions (M, N) in which the normal matrix is zero, by subspace iteration."""
    from scipy import sparse  # noqa: PLC0415
    from scipy.sparse.linalg import splu  # noqa: PLC0415

    size = normal.shape[0]
    inverse = splu((normal + _SHIFT * sparse.eye_array(size, format="csc")).tocsc())
    directions = np.random.default_rng(0).normal(size=(size, min(size, _MAX_DIRECTIONS)))
    for _ in range(_ITERATIONS):
        directions, _ = np.linalg.qr(inverse.solve(directions))
    curvature, turn = np.linalg.eigh(directions.T @ (normal @ directions))
    vectors: FloatArray = (directions @ turn).T[curvature < _NULL]
    return vectors


def _weak(problem: Problem, keys: list[int]) -> list[Factor]:
    """Return priors that hold variables about where they are."""
    return [
        factor.cloneWithNewNoiseModel(
            gtsam.noiseModel.Isotropic.Sigma(_size(problem, key), _WEAK_SIGMA)
        )
        for key, factor in zip(keys, fixes(problem.map, problem.values, keys), strict=True)
    ]
