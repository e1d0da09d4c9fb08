"""A second implementation of the solver, for checks: Levenberg-Marquardt on SciPy's sparse matrices.

It shares nothing with gtsam but the graph it reads: residuals, Jacobians and the linear solver are its own.
It knows edges between poses, priors on poses, and poses that are held.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import gtsam
import numpy as np

from mapstream.operators.estimation.outliers.consistency import adjoint
from mapstream.operators.estimation.solvers import Graph, Limits, Solved
from mapstream.operators.estimation.states import Values
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import hat, invert, se3_exp, se3_log

_RELATIVE_TOLERANCE = 1e-9
_MAX_LAMBDA = 1e12
_SERIES = (  # Bernoulli numbers by factorials, of even powers
    1 / 12, -1 / 720, 1 / 30240, -1 / 1209600, 2.08767569878681e-08,
    -5.284190138687493e-10, 1.3382536530684679e-11, -3.3896802963225827e-13,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Measurements:
    """T_a_b with roots of information; `a` is -1 where the pose b itself was measured."""

    a: IntArray
    b: IntArray
    T_a_b: FloatArray  # (N, 4, 4)
    root: FloatArray  # (N, 6, 6)


def sparse_levenberg_marquardt(graph: Graph, values: Values, limits: Limits) -> Solved:
    """Minimise without gtsam's solvers.

    Raises:
        EstimationError: If the graph has factors of other kinds, or a loss.
    """
    keys = np.array(list(values.keys()), dtype=np.int64)
    poses = np.array([values.atPose3(key).matrix() for key in keys.tolist()])
    measured, held = _read(graph, keys)
    is_free = np.ones(len(keys), dtype=bool)
    is_free[held] = False
    damping, iterations, is_converged = limits.initial_lambda, 0, False
    error = _error(measured, poses)
    while not is_converged and iterations < limits.max_iterations:
        if time.perf_counter() > limits.end_s or damping > _MAX_LAMBDA:
            break
        iterations += 1
        step = _step(measured, poses, is_free, damping)
        moved = poses @ se3_exp(step)
        after = _error(measured, moved)
        if not after < error:
            damping *= 10
            is_converged = damping > _MAX_LAMBDA
            continue
        is_converged = error - after <= _RELATIVE_TOLERANCE * error
        poses, error, damping = moved, after, damping / 10
    result = gtsam.Values()
    for key, pose in zip(keys.tolist(), poses, strict=True):
        result.insert(key, gtsam.Pose3(pose))
    return Solved(
        values=result,
        error=error,
        iterations=iterations,
        is_converged=is_converged,
        final_lambda=damping,
    )


def _read(graph: Graph, keys: IntArray) -> tuple[_Measurements, list[int]]:
    """Return what gtsam's graph measures, and the poses that it holds."""
    place = {key: index for index, key in enumerate(keys.tolist())}
    a, b, T, roots, held = [], [], [], [], []
    for index in range(graph.size()):
        factor = graph.at(index)
        noise = factor.noiseModel()
        is_prior = isinstance(factor, gtsam.PriorFactorPose3)
        if not is_prior and not isinstance(factor, gtsam.BetweenFactorPose3):
            raise EstimationError(
                f"the sparse solver knows poses alone, not {type(factor).__name__}; use solver: lm"
            )
        if isinstance(noise, gtsam.noiseModel.Robust):
            raise EstimationError("the sparse solver knows no losses; use solver: lm")
        if noise.isConstrained():
            held.append(place[factor.keys()[0]])
            continue
        ends = [place[key] for key in factor.keys()]  # noqa: SIM118  # gtsam's list
        a.append(-1 if is_prior else ends[0])
        b.append(ends[-1])
        T.append((factor.prior() if is_prior else factor.measured()).matrix())
        roots.append(noise.R())
    return _Measurements(
        np.array(a, np.int64),
        np.array(b, np.int64),
        np.array(T).reshape(-1, 4, 4),
        np.array(roots).reshape(-1, 6, 6),
    ), held


def _residuals(measured: _Measurements, poses: FloatArray) -> FloatArray:
    first = np.where((measured.a < 0)[:, None, None], np.eye(4), poses[measured.a])
    return se3_log(invert(measured.T_a_b) @ invert(first) @ poses[measured.b])


def _error(measured: _Measurements, poses: FloatArray) -> float:
    weighted = np.einsum("nij,nj->ni", measured.root, _residuals(measured, poses))
    return 0.5 * float((weighted**2).sum())


def _step(
    measured: _Measurements, poses: FloatArray, is_free: BoolArray, damping: float
) -> FloatArray:
    """Return the step (N, 6) of all poses; those that are held get zero."""
    from scipy import sparse  # noqa: PLC0415  # takes most of a second to import
    from scipy.sparse.linalg import splu  # noqa: PLC0415

    left = _residuals(measured, poses)
    by_b = measured.root @ inverse_right_jacobian(left)
    is_relative = measured.a >= 0
    b_to_a = adjoint(invert(poses[measured.b]) @ poses[measured.a])
    by_a = -by_b @ b_to_a
    count, six = len(left), np.arange(6)
    row = np.broadcast_to(6 * np.arange(count)[:, None, None] + six[:, None], (count, 6, 6))
    entries = np.concatenate([by_b.ravel(), by_a[is_relative].ravel()])
    rows = np.concatenate([row.ravel(), row[is_relative].ravel()])
    columns = [
        np.broadcast_to(6 * ends[:, None, None] + six, (len(ends), 6, 6)).ravel()
        for ends in (measured.b, measured.a[is_relative])
    ]
    shape = (6 * count, 6 * len(poses))
    jacobian = sparse.coo_array((entries, (rows, np.concatenate(columns))), shape=shape).tocsc()
    free = np.flatnonzero(np.repeat(is_free, 6))
    jacobian = jacobian[:, free]
    normal = (jacobian.T @ jacobian).tocsc()
    weighted = np.einsum("nij,nj->ni", measured.root, left).ravel()
    damped = normal + damping * sparse.eye_array(len(free), format="csc")
    step = np.zeros(6 * len(poses))
    step[free] = splu(damped).solve(-(jacobian.T @ weighted))
    return step.reshape(-1, 6)


def inverse_right_jacobian(xi: FloatArray) -> FloatArray:
    """Return the inverses (N, 6, 6) of the right Jacobians of SE(3) at tangents (N, 6), rotation first.

    By its power series (Barfoot, State Estimation for Robotics, 2017, eq. 7.99), which is exact to rounding where
    rotations are small, as those of residuals near the minimum are.
    """
    ad = np.zeros((len(xi), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = hat(xi[:, :3])
    ad[:, 3:, :3] = hat(xi[:, 3:])
    result: FloatArray = np.eye(6) + 0.5 * ad
    square = ad @ ad
    power = square
    for coefficient in _SERIES:
        result = result + coefficient * power
        power = power @ square
    return result
