"""Covariances of motion: how those of steps add up, and what a step is worth that nobody measured."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3

UNMEASURED_SIGMAS = (0.5, 0.5, 0.5, 5.0, 5.0, 5.0)  # [rad, m] of a predicted step, per second


def diagonal(sigma_rad: float, sigma_m: float) -> FloatArray:
    """Return the covariance (6, 6) of independent axes, rotation first."""
    return np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)


def unmeasured(duration_s: float) -> FloatArray:
    """Return the covariance (6, 6) of a step that only a motion model says (OmniMapper, section IV-D3)."""
    return np.diag(np.square(UNMEASURED_SIGMAS)) * max(duration_s, 0.1)


def chain(covariance: FloatArray, step: SE3, step_covariance: FloatArray) -> FloatArray:
    """Return the covariance (6, 6) of a motion followed by one more step.

    Perturbations are on the right, so what was uncertain before the step is seen from after it.
    """
    adjoint = step.inverse().adjoint()
    total: FloatArray = adjoint @ covariance @ adjoint.T + step_covariance
    return total
