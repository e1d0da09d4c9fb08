"""Which position fixes are true, where an IMU alone leads from one to the next: many hypotheses at once.

Each hypothesis says of every fix whether it is true, and follows the state by a Kalman filter that takes the true
ones. A fix splits every hypothesis in two. Those far less likely than the best are dropped, so that a wrong verdict
does not lock out what comes after it: the right one is still among the others, and later fixes find it.
A verdict is sure while all likely hypotheses share it; it stands where it lies so far back that the best has to do.
How the robot heads at first is a guess as well, so there are hypotheses for headings all around.

Sources: Reid, An algorithm for tracking multiple targets, TAC 1979; Alspach and Sorenson, Nonlinear Bayesian
estimation using Gaussian sum approximations, TAC 1972; the filter is that of Barrau and Bonnabel, TAC 2017.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from mapstream.operators.estimation.outliers.inertial_steps import (
    BIASES,
    POSITION,
    ROTATION,
    STATE,
    VELOCITY,
    InertialStep,
)
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.geometry import hat, so3_exp, symmetric

_NUM_HEADINGS = 16
_START_SIGMAS = (0.15, 0.15, 1.2 * np.pi / _NUM_HEADINGS, *[300.0] * 3, *[30.0] * 3)  # rad, m, m/s
_START_BIAS_SIGMAS = (*[0.5] * 3, *[0.01] * 3)  # m/s^2, rad/s; beyond it headings lose their way
_DOUBT = 3.0  # times the variance that the IMU's noise is said to have
_REACH_M = 20.0  # how far a false fix lies from the truth, by order of magnitude
_FALSE_COST = 8.0  # of calling a fix false; dear, as models of noise are wrong now and then
_FURTHEST_COST = 40.0  # more than the best hypothesis has that one may have
_LIKELY_COST = 12.0  # more than the best's that one has which still sheds doubt on a verdict
_MOST = 600  # hypotheses
_DECIDED_AFTER = 20  # fixes
_SAME_RAD, _SAME_MPS = 0.05, 1.0  # two hypotheses with one verdict are one if they are so near


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """A measured position."""

    p: FloatArray  # (3,) of the sensor, in an upright frame [m]
    covariance: FloatArray  # (3, 3) in its axes
    lever: FloatArray  # (3,) of the sensor on the base [m]


@dataclass(frozen=True, slots=True, eq=False)
class _Beam:
    """H hypotheses, the best first."""

    R: FloatArray  # (H, 3, 3)
    p: FloatArray  # (H, 3)
    v: FloatArray  # (H, 3)
    biases: FloatArray  # (H, 6), the accelerometer's first
    covariance: FloatArray  # (H, 15, 15) of errors seen from the base
    cost: FloatArray  # (H,) negative logarithm of likelihood
    is_true: BoolArray  # (H, F) of the fixes that are not decided

    def chosen(self, rows: IntArray | BoolArray) -> _Beam:
        return _Beam(*(getattr(self, field.name)[rows] for field in fields(self)))


class FixHypotheses:
    """Hypotheses on the fixes of one drive, in the order of time."""

    def __init__(self, R_upright: FloatArray, first: Fix) -> None:
        """Begin at the first fix, which is not yet judged.

        Args:
            R_upright: (3, 3) of the base, right but for its heading and a few degrees.
            first: Where about the robot is.
        """
        yaws = np.linspace(0.0, 2 * np.pi, _NUM_HEADINGS, endpoint=False)
        num, around = _NUM_HEADINGS, np.zeros((_NUM_HEADINGS, 3))
        around[:, 2] = yaws
        sigmas = np.array([*_START_SIGMAS, *_START_BIAS_SIGMAS])
        self._beam = _Beam(
            R=so3_exp(around) @ R_upright,
            p=np.tile(first.p, (num, 1)),
            v=np.zeros((num, 3)),
            biases=np.zeros((num, 6)),
            covariance=np.tile(np.diag(sigmas**2), (num, 1, 1)),
            cost=np.zeros(num),
            is_true=np.zeros((num, 0), dtype=bool),
        )
        self._decided: list[bool] = []  # of the first fixes: whether they are true

    def move(self, step: InertialStep) -> None:
        """Go on to the next vertex."""
        self._beam = _moved(self._beam, step)

    def judge(self, fix: Fix) -> None:
        """Split each hypothesis in one where the fix is true and one where it is false; keep the likely ones."""
        beam = _thinned(_split(self._beam, fix))
        while beam.is_true.shape[1] > _DECIDED_AFTER or _is_common(beam.is_true[:, :1]).any():
            verdict = bool(beam.is_true[0, 0])
            self._decided.append(verdict)
            beam = beam.chosen(beam.is_true[:, 0] == verdict)
            beam = replace(beam, is_true=beam.is_true[:, 1:])
        self._beam = beam

    def likeliest(self) -> list[bool]:
        """Return of each fix whether it is true, by the best hypothesis."""
        best: list[bool] = self._beam.is_true[0].tolist()
        return [*self._decided, *best]

    def are_sure(self) -> list[bool]:
        """Return of each fix whether all likely hypotheses say the same of it."""
        likely = self._beam.is_true[self._beam.cost < _LIKELY_COST]
        common: list[bool] = _is_common(likely).tolist()
        return [True] * len(self._decided) + common


def _is_common(verdicts: BoolArray) -> BoolArray:
    """Return of each column of (H, F) whether all rows agree."""
    common: BoolArray = (verdicts == verdicts[0]).all(axis=0)
    return common


def _moved(beam: _Beam, step: InertialStep) -> _Beam:
    off = (beam.biases - step.biases) @ step.transition[:9, BIASES].T  # by other biases
    R = beam.R @ step.R
    p = beam.p + beam.v * step.seconds + 0.5 * step.gravity * step.seconds**2 + beam.R @ step.p
    v = beam.v + step.gravity * step.seconds + beam.R @ step.v
    spread = step.transition @ beam.covariance @ step.transition.T + _DOUBT * step.noise
    return _shifted(replace(beam, R=R, p=p, v=v, covariance=spread), off)


def _shifted(beam: _Beam, by: FloatArray) -> _Beam:
    """Return the states moved by (H, 9), or (H, 15) with biases, seen from the base."""
    return replace(
        beam,
        R=beam.R @ so3_exp(by[:, ROTATION]),
        p=beam.p + _turned(beam.R, by[:, POSITION]),
        v=beam.v + _turned(beam.R, by[:, VELOCITY]),
        biases=beam.biases + by[:, BIASES] if by.shape[1] == STATE else beam.biases,
    )


def _turned(R: FloatArray, vectors: FloatArray) -> FloatArray:
    turned: FloatArray = np.einsum("hij,hj->hi", R, vectors)
    return turned


def _split(beam: _Beam, fix: Fix) -> _Beam:
    """Return twice as many hypotheses: first those where the fix is true."""
    by_state = np.zeros((3, STATE))
    by_state[:, ROTATION], by_state[:, POSITION] = -hat(fix.lever), np.eye(3)
    R_base = beam.R.swapaxes(1, 2)
    error = _turned(R_base, fix.p - beam.p) - fix.lever
    with_fix = beam.covariance @ by_state.T  # (H, 15, 3)
    spread = by_state @ with_fix + R_base @ fix.covariance @ beam.R
    gain = with_fix @ np.linalg.inv(spread)
    chi2 = np.einsum("hi,hi->h", error, np.linalg.solve(spread, error[:, :, None])[:, :, 0])
    true = replace(
        _shifted(beam, _turned(gain, error)),
        covariance=symmetric(beam.covariance - gain @ with_fix.swapaxes(1, 2)),
        cost=beam.cost + 0.5 * (np.linalg.slogdet(spread)[1] + chi2),
    )
    anywhere = np.linalg.slogdet(spread + _REACH_M**2 * np.eye(3))[
        1
    ]  # that much room a false one has
    false = replace(beam, cost=beam.cost + 0.5 * anywhere + _FALSE_COST)
    both = [np.concatenate([getattr(each, f.name) for each in (true, false)]) for f in fields(beam)]
    verdict = np.repeat([True, False], len(beam.cost))
    return replace(_Beam(*both), is_true=np.column_stack([both[-1], verdict]))


def _thinned(beam: _Beam) -> _Beam:
    """Return the likely hypotheses, the best first, each state and verdict once; the best costs nothing."""
    order = np.argsort(beam.cost, kind="stable")
    beam = beam.chosen(order[beam.cost[order] < beam.cost[order[0]] + _FURTHEST_COST])
    verdicts = np.unique(beam.is_true, axis=0, return_inverse=True)[1].ravel()
    kept: list[int] = []
    with_verdict: dict[int, list[int]] = {}
    for row, verdict in enumerate(verdicts.tolist()):
        better = with_verdict.setdefault(verdict, [])
        if len(kept) < _MOST and not _is_near(beam, row, better):
            better.append(row)
            kept.append(row)
    beam = beam.chosen(np.array(kept, dtype=np.int64))
    return replace(beam, cost=beam.cost - beam.cost[0])


def _is_near(beam: _Beam, row: int, others: list[int]) -> bool:
    """Return whether one of the others has nearly this state."""
    if not others:
        return False
    trace = np.einsum("hij,ij->h", beam.R[others], beam.R[row])
    slower = np.linalg.norm(beam.v[others] - beam.v[row], axis=1)
    return bool(((trace > 1 + 2 * np.cos(_SAME_RAD)) & (slower < _SAME_MPS)).any())
