"""Fixes on a mission that only an IMU leads along: which of them the others contradict.

No rigid trajectory says where a fix should be, as `absolute_outliers.py` needs it: the state between two fixes is
as uncertain as the IMU was long alone. So each fix is judged by its error in units of both uncertainties, and left
out where that is more than chance.

Source: Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 2001, section 5.4.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import gtsam
import numpy as np

from mapstream.operators.estimation.incremental import IncrementalProblem, Name
from mapstream.operators.estimation.noise import Factor
from mapstream.operators.estimation.outliers.consistency import chi2_gate
from mapstream.operators.estimation.states import Values
from mapstream.streams.arrays import FloatArray

_CHANCE = 1e-6  # that a true fix is left out; small, since models of an IMU's noise are wrong
_NEAR_CHI2 = 1.0  # a fix so near the solution is not asked whether it bent it
_LEAST_VARIANCE = (
    1e-3  # of the error of a fix that alone determines something, and contradicts nothing
)
Judge = Callable[[IncrementalProblem, Mapping[Name, Factor]], set[Name]]
"""Lets fixes into a problem, and returns the names of those that stay out."""


def take_in(problem: IncrementalProblem, fixes: Mapping[Name, Factor]) -> set[Name]:
    """Add those fixes that those before them do not contradict; return the names of the others.

    Args:
        problem: That has all else that is known at the time of the last fix.
        fixes: In the order of time. Each that is taken moves what is expected of the next, to first order.
    """
    if not fixes:
        return set()
    values = problem.values()
    covariance, place = problem.covariance({key for fix in fixes.values() for key in fix.keys()})  # noqa: SIM118
    moved, taken = np.zeros(len(covariance)), {}
    for name, fix in fixes.items():
        jacobian, error = _linear(fix, values, place, len(moved))
        innovation = error - jacobian @ moved
        variance = np.eye(len(error)) + jacobian @ covariance @ jacobian.T
        if innovation @ np.linalg.solve(variance, innovation) > _gate(fix):
            continue
        gain = np.linalg.solve(variance, jacobian @ covariance).T
        moved, covariance = moved + gain @ innovation, covariance - gain @ jacobian @ covariance
        taken[name] = fix
    if taken:
        problem.update(gtsam.Values(), taken)
    return fixes.keys() - taken.keys()


def review(problem: IncrementalProblem, fixes: Mapping[Name, Factor]) -> set[Name]:
    """Judge each fix by all others, before it and after; return the names of those that are left out.

    Args:
        problem: With those of the fixes that were taken in.
        fixes: All, in the order of time.
    """
    for _ in range(len(fixes)):
        inside = {name: problem.factors[name] for name in fixes if name in problem.factors}
        worst = _worst(problem, inside)
        if worst is None:
            break
        problem.update(gtsam.Values(), {}, [worst])
        problem.settle()
    outside = {name: fix for name, fix in fixes.items() if name not in problem.factors}
    return {name for name, fix in outside.items() if take_in(problem, {name: fix})}


def _worst(problem: IncrementalProblem, fixes: Mapping[Name, Factor]) -> Name | None:
    """Return the fix that the others contradict most, if it is by more than chance.

    Only one, since a false fix makes its neighbours look false.
    """
    values = problem.values()
    far = {name: fix for name, fix in fixes.items() if 2 * fix.error(values) > _NEAR_CHI2}
    chi2 = {name: _chi2_without(problem, fix, values) for name, fix in far.items()}
    worst = max(chi2, key=lambda name: chi2[name], default=None)
    return worst if worst is not None and chi2[worst] > _gate(fixes[worst]) else None


def _chi2_without(problem: IncrementalProblem, fix: Factor, values: Values) -> float:
    """Return the chi2 of the error that a fix would have if the problem were without it."""
    covariance, place = problem.covariance(fix.keys())
    jacobian, error = _linear(fix, values, place, len(covariance))
    variances, axes = np.linalg.eigh(np.eye(len(error)) - jacobian @ covariance @ jacobian.T)
    return float(((axes.T @ error) ** 2 / np.maximum(variances, _LEAST_VARIANCE)).sum())


def _linear(
    fix: Factor, values: Values, place: Mapping[int, slice], size: int
) -> tuple[FloatArray, FloatArray]:
    """Return the whitened jacobian (D, size) and error (D,), which a step x makes error - jacobian x."""
    own, error = fix.linearize(values).jacobian()
    jacobian, at = np.zeros((len(error), size)), 0
    for key in fix.keys():  # noqa: SIM118  # gtsam's
        num = place[key].stop - place[key].start
        jacobian[:, place[key]] = own[:, at : at + num]
        at += num
    return jacobian, error


def _gate(fix: Factor) -> float:
    return float(chi2_gate(int(fix.dim()), 1 - _CHANCE))
