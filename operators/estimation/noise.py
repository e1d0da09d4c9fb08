"""Covariances as gtsam's noise models, exact where a direction was not measured."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from mapstream.operators.odometry.uncertainty import OPEN_VARIANCE, is_whole
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError

Factor = Any  # gtsam has no types
_POSE = 6  # dimensions of one


def noise_from_covariance(covariance: FloatArray, jacobian: FloatArray | None = None) -> Any:  # noqa: ANN401
    """Return the noise model of a covariance (N, N), of poses (6, 6) with rotation first [rad, m].

    A direction that was not measured, an axis of infinite variance or any direction of `OPEN_VARIANCE` or more
    in a pose's, has no information at all, never that of a huge sigma. `gtsam.noiseModel.Gaussian.Information` is silently wrong for singular matrices, hence the root.

    Args:
        covariance: Of the measurement's error.
        jacobian: (N, M) of the measurement's error by the factor's error, where these differ.

    Raises:
        EstimationError: If a finite part is not positive definite, or a NaN is in it.
    """
    is_measured = np.isfinite(np.diagonal(covariance))
    measured = covariance[np.ix_(is_measured, is_measured)]
    if np.isnan(covariance).any() or not np.isfinite(measured).all():
        raise EstimationError(f"a covariance with undefined values: {covariance.tolist()}")
    eigenvalues, vectors = np.linalg.eigh(measured)
    if measured.size and eigenvalues[0] <= 0:
        raise EstimationError(f"a covariance must be positive definite: {covariance.tolist()}")
    is_closed = eigenvalues < (OPEN_VARIANCE if len(covariance) == _POSE else np.inf)
    if (
        jacobian is None
        and is_closed.all()
        and np.array_equal(measured, np.diag(np.diagonal(measured)))
    ):
        precisions = np.zeros(len(covariance))
        precisions[is_measured] = 1 / np.diagonal(measured)
        return gtsam.noiseModel.Diagonal.Precisions(precisions)
    root = np.zeros_like(covariance)
    root[np.ix_(is_measured, is_measured)] = (vectors * is_closed / np.sqrt(eigenvalues)).T
    if jacobian is not None:
        root = root @ jacobian
    return gtsam.noiseModel.Gaussian.SqrtInformation(root, False)  # noqa: FBT003  # smart=False


class NoiseModels:
    """Noise models by covariance, each made once: most edges of a map share a few."""

    def __init__(self) -> None:
        self._made: dict[bytes, Any] = {}

    def __call__(self, covariance: FloatArray, jacobian: FloatArray | None = None) -> Any:  # noqa: ANN401
        """Return the noise of a covariance, as `noise_from_covariance`."""
        key = covariance.tobytes() + (b"" if jacobian is None else jacobian.tobytes())
        if key not in self._made:
            self._made[key] = noise_from_covariance(covariance, jacobian)
        return self._made[key]

    def of_all(self, covariances: FloatArray) -> list[Any]:
        """Return the noise of each covariance (N, M, M), made together: several times as fast as one by one.

        Raises:
            EstimationError: As `noise_from_covariance`.
        """
        keys = [covariance.tobytes() for covariance in covariances]
        new = {key: row for row, key in enumerate(keys) if key not in self._made}
        self._make(list(new), covariances[list(new.values())])
        made = self._made
        return [
            made[key] if key in made else self(covariance)
            for key, covariance in zip(keys, covariances, strict=True)
        ]

    def _make(self, keys: list[bytes], covariances: FloatArray) -> None:
        """Make the noise of covariances; those with a direction that was not measured are left out."""
        is_finite = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
        if covariances.shape[-1] == _POSE:
            is_finite &= is_whole(covariances)
        filled = np.where(is_finite[:, None, None], covariances, np.eye(covariances.shape[-1]))
        try:
            roots = np.linalg.inv(np.linalg.cholesky(filled))
        except np.linalg.LinAlgError:  # one is no covariance: its own call says which
            return
        for key, root, is_usable in zip(keys, roots, is_finite.tolist(), strict=True):
            if is_usable:
                self._made[key] = gtsam.noiseModel.Gaussian.SqrtInformation(root, False)  # noqa: FBT003  # smart=False


def switchable(noise: Any, prior_weight: float) -> Any:  # noqa: ANN401
    """Return the noise of a switchable constraint whose switch is eliminated.

    With the prior weight Phi on a switch, the best switch is Phi / (Phi + chi2), and the cost that is left is
    that of Geman-McClure with c = sqrt(Phi) (Suenderhauf and Protzel, IROS 2012; Agarwal et al., ICRA 2013).
    """
    loss = gtsam.noiseModel.mEstimator.GemanMcClure.Create(float(np.sqrt(prior_weight)))
    return gtsam.noiseModel.Robust.Create(loss, noise)
