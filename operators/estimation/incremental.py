"""The map's problem while it grows: iSAM2 (Kaess et al., IJRR 2012), factors added and removed by name.

All variables stay in the problem (square root smoothing), so that a loop moves the whole past.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import gtsam
import numpy as np

from mapstream.operators.estimation.keys import Variable, key_of, rows_by_variable
from mapstream.operators.estimation.noise import Factor
from mapstream.operators.estimation.states import Values
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError

Name = bytes  # of a factor; the caller chooses it
_WEAK_SIGMA = 1e3  # [rad, m]: what holds a variable that nothing determines
_WEAK_VELOCITY_MPS = 100.0
_WEAK_BIAS = 1.0  # [m/s^2, rad/s]


class IncrementalProblem:
    """Variables of any kind under the keys of `keys.py`, and factors under names of the caller's choice.

    Where iSAM2 finds the problem indeterminate, as its Cholesky does on long chains of weak edges, it is
    solved as a whole and iSAM2 starts anew from there, which `num_rebuilds` counts; then with QR. Poses that
    are not determined even so get a weak prior, which `num_weak` counts.
    """

    def __init__(self) -> None:
        self.num_rebuilds = 0
        self.num_weak = 0
        self._factors: dict[Name, Factor] = {}
        self._indices: dict[Name, int] = {}  # of the factors inside iSAM2
        self._keys: set[int] = set()
        self._is_precise = False  # Cholesky was not precise enough
        self._is_weak = False  # it was indeterminate as a whole, so each new variable gets a prior
        self._isam = _new_isam(is_precise=False)
        self._sound = gtsam.Values()  # the newest solution that was one
        self._estimate: Values | None = (
            None  # of this moment, once it was asked for: it takes its time
        )

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def factors(self) -> Mapping[Name, Factor]:
        """All factors by name, the problem's own weak priors among them."""
        return self._factors

    @property
    def names(self) -> set[Name]:
        """The factors that are in the problem, without its own weak priors."""
        return {name for name in self._factors if not name.startswith(b"weak")}

    def new_keys(self, factors: Iterable[Factor]) -> set[int]:
        """Return the variables of these factors that the problem does not have yet."""
        return {key for factor in factors for key in factor.keys()} - self._keys  # noqa: SIM118  # gtsam's

    def update(
        self, values: Values, add: Mapping[Name, Factor], remove: Iterable[Name] = ()
    ) -> None:
        """Add variables with these values, add and remove factors, and solve.

        Raises:
            EstimationError: If the variables are not determined even with weak priors.
        """
        gone = [self._indices.pop(name) for name in remove]
        for name in remove:
            del self._factors[name]
        added = dict(add)
        if self._is_weak:
            added |= self._weak_priors(values, values.keys())
        self._keys |= set(values.keys())
        self._factors |= added
        self._estimate = None
        try:
            result = self._isam.update(_graph_of(added.values()), values, gone)
            self._indices.update(zip(added, result.getNewFactorsIndices(), strict=True))
            self._require_finite()
        except RuntimeError:
            self._rebuild(values)
        self._sound = self.values()

    def settle(self, tolerance_m: float = 1e-5, most: int = 20) -> None:
        """Go on until no pose moves further than the tolerance: a loop takes several steps to sink in."""
        old = self._positions()
        for _ in range(most):
            self._isam.update()
            self._estimate = None
            new = self._positions()
            if np.abs(new - old).max(initial=0.0) < tolerance_m:
                return
            old = new

    def values(self) -> Values:
        """Return the present estimate of all variables."""
        if self._estimate is None:
            self._estimate = self._isam.calculateEstimate()
        return self._estimate

    def chi2(self) -> float:
        """Return the squared weighted error of all factors at the present estimate."""
        values = self.values()
        return 2 * sum(float(factor.error(values)) for factor in self._factors.values())

    def covariance(self, keys: Iterable[int]) -> tuple[FloatArray, dict[int, slice]]:
        """Return the joint covariance (D, D) of variables in their tangent spaces, and where each lies in it."""
        ordered = sorted(keys)
        joint = self._isam.jointMarginalCovariance(ordered)
        ends = np.cumsum([0, *(len(joint.at(key, key)) for key in ordered)]).tolist()
        place = {key: slice(*ends[at : at + 2]) for at, key in enumerate(ordered)}
        return np.block([[joint.at(a, b) for b in ordered] for a in ordered]), place

    def reset(self, values: Values, factors: Mapping[Name, Factor]) -> None:
        """Start anew with values and factors, for instance after a batch optimisation.

        Raises:
            EstimationError: If the variables are not determined.
        """
        self._factors, self._keys = dict(factors), set(values.keys())
        if self._is_weak:
            self._factors |= self._weak_priors(values, values.keys())
        try:
            self._start(values)
        except RuntimeError:
            self._rebuild(values)
        self._sound = self.values()

    def _require_finite(self) -> None:
        """QR does not say that a problem is singular, as Cholesky does: it gives infinite steps.

        Raises:
            RuntimeError: If there is one.
        """
        if self._is_precise and not np.isfinite(self._positions()).all():
            raise RuntimeError("the solution is not finite")

    def _positions(self) -> Any:  # noqa: ANN401  # (N, 12) of all poses
        return gtsam.utilities.extractPose3(self.values())

    def _start(self, values: Values) -> None:
        isam = _new_isam(is_precise=self._is_precise)
        result = isam.update(_graph_of(self._factors.values()), values)
        self._indices = dict(zip(self._factors, result.getNewFactorsIndices(), strict=True))
        self._isam, self._estimate = isam, None
        self._require_finite()

    def _rebuild(self, added: Values) -> None:
        """Solve the whole, from where iSAM2 stood when it failed; with weak priors if it must be."""
        self.num_rebuilds += 1
        start = gtsam.Values(self._sound)
        for key in start.keys():  # noqa: SIM118  # gtsam's values are no mapping
            if key not in self._keys or added.exists(key):
                start.erase(key)
        start.insert(added)
        reason = ""
        for remedy in (self._as_it_is, self._precisely, self._weakly):
            remedy(start)
            try:
                self._solve_and_start(start)
            except RuntimeError as error:
                reason = str(error).strip()
            else:
                return
        raise EstimationError(f"the problem is not determined: {reason}")

    def _as_it_is(self, start: Values) -> None:
        """From a better linearisation point it may be determined."""

    def _precisely(self, start: Values) -> None:  # noqa: ARG002  # as the other remedies
        """QR keeps twice as many digits as Cholesky, which weak and strong edges together need."""
        self._is_precise = True

    def _weakly(self, start: Values) -> None:
        self._is_weak = True
        self._factors |= self._weak_priors(start, self._keys)

    def _solve_and_start(self, start: Values) -> None:
        params = gtsam.LevenbergMarquardtParams()
        if self._is_precise:
            params.setLinearSolverType("MULTIFRONTAL_QR")
        graph = _graph_of(self._factors.values())
        self._start(gtsam.LevenbergMarquardtOptimizer(graph, start, params).optimize())

    def _weak_priors(self, values: Values, keys: Iterable[int]) -> dict[Name, Factor]:
        """Return a prior on each of the variables, where it is, too weak to matter where anything else speaks."""
        priors: dict[Name, Factor] = {}
        for variable, rows in rows_by_variable(keys).items():
            for row in rows.tolist():
                prior = _weak_prior(variable, key_of(variable, row), values)
                if prior is not None:
                    priors[b"weak%s%d" % (variable.encode(), row)] = prior
        self.num_weak += len(priors)
        return priors


def _weak_prior(variable: Variable, key: int, values: Values) -> Factor | None:
    if variable in ("pose", "frame", "extrinsics"):
        noise = gtsam.noiseModel.Isotropic.Sigma(6, _WEAK_SIGMA)
        return gtsam.PriorFactorPose3(key, values.atPose3(key), noise)
    if variable == "velocity":
        noise = gtsam.noiseModel.Isotropic.Sigma(3, _WEAK_VELOCITY_MPS)
        return gtsam.PriorFactorVector(key, values.atVector(key), noise)
    if variable == "bias":
        noise = gtsam.noiseModel.Isotropic.Sigma(6, _WEAK_BIAS)
        return gtsam.PriorFactorConstantBias(key, values.atConstantBias(key), noise)
    return None  # landmarks come with what measured them


def _graph_of(factors: Iterable[Factor]) -> Any:  # noqa: ANN401
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def _new_isam(*, is_precise: bool) -> Any:  # noqa: ANN401
    params = gtsam.ISAM2Params()
    params.setFactorization("QR" if is_precise else "CHOLESKY")
    params.setRelinearizeThreshold(0.01)
    params.relinearizeSkip = 1
    return gtsam.ISAM2(params)
