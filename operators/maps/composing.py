"""Measured motions put one after another, with their covariances.

Perturbations are on the right, so that exp(a) T exp(b) = T exp(Ad(T^-1) a + b) to first order
(Sola et al., "A micro Lie theory", 2018, section III-B).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import FloatArray, frozen
from mapstream.streams.geometry import SE3

_NEGLIGIBLE = 1e-12  # of an adjoint: what rounding leaves


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A measured transform; an infinite variance says that a direction was not measured."""

    T: SE3
    covariance: FloatArray  # (6, 6) rotation first [rad, m]

    def __post_init__(self) -> None:
        frozen(self, "covariance", np.float64, (6, 6))

    @classmethod
    def exact(cls, T: SE3) -> Motion:
        return cls(T, np.zeros((6, 6)))

    def then(self, other: Motion) -> Motion:
        """Return the motion over both; a direction that one of them left open stays open, and no other."""
        carry = other.T.inverse().adjoint()
        open_self = np.isinf(np.diagonal(self.covariance))
        open_other = np.isinf(np.diagonal(other.covariance))
        is_open = (np.abs(carry) > _NEGLIGIBLE) @ open_self | open_other
        carried = carry @ _measured(self.covariance, open_self) @ carry.T
        covariance = carried + _measured(other.covariance, open_other)
        covariance = _measured((covariance + covariance.T) / 2, is_open)
        covariance[is_open, is_open] = np.inf
        return Motion(self.T @ other.T, covariance)


def composed(motions: Iterable[Motion]) -> Motion:
    """Return the motion over all of these, in order."""
    first, *rest = motions
    for motion in rest:
        first = first.then(motion)
    return first


def _measured(
    covariance: FloatArray, is_open: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> FloatArray:
    """Return the covariance with zeros in the rows and columns of open directions."""
    crossing = is_open[:, None] | is_open
    return np.where(crossing, 0.0, covariance)
