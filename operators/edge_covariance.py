"""How sure a measurement is, as a graph file says it: one constant per sensor, for messages that do not say."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import FloatArray

_Three = Annotated[tuple[PositiveFloat, ...], Field(min_length=3, max_length=3)]
_Row = Annotated[tuple[float, ...], Field(min_length=6, max_length=6)]
_Matrix = Annotated[tuple[_Row, ...], Field(min_length=6, max_length=6)]
_Sigma = PositiveFloat | _Three | None


class PoseCovariance(OperatorConfig):
    """The covariance of a measured transform: by standard deviations, or as a whole.

    Tangent vectors have the rotation first; the perturbation is on the right, in the axes of the second frame.
    """

    sigma_rad: _Sigma = None
    """Of the rotation about x, y and z, or of all three; `null`: rotations were not measured."""
    sigma_m: _Sigma = None
    """The same, of the translation."""
    matrix: _Matrix | None = None
    """All of it (6, 6), rotation first [rad, m]; instead of sigmas."""

    @model_validator(mode="after")
    def _check(self) -> PoseCovariance:
        has_sigmas = self.sigma_rad is not None or self.sigma_m is not None
        if has_sigmas == (self.matrix is not None):
            raise ValueError("a covariance has sigma_rad, sigma_m or both, or else a matrix")
        if self.matrix is not None:
            matrix = np.array(self.matrix)
            if not (np.allclose(matrix, matrix.T) and np.linalg.eigvalsh(matrix)[0] > 0):
                raise ValueError("a covariance is symmetric and positive definite")
        return self

    def constant(self) -> FloatArray:
        """Return the covariance (6, 6); infinite where nothing is measured."""
        if self.matrix is not None:
            return np.array(self.matrix, dtype=np.float64)
        sigmas = [np.inf if s is None else s for s in (self.sigma_rad, self.sigma_m)]
        return np.diag(np.concatenate([np.square(np.broadcast_to(s, 3)) for s in sigmas]))

    def of(self, measured: FloatArray | None) -> FloatArray:
        """Return the message's covariance (6, 6) where it has one, otherwise the constant."""
        return self.constant() if measured is None else measured
