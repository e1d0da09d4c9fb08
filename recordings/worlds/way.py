"""Ways along straight lines, whose corners are rounded."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import FloatArray

STEP_M = 0.02  # between points of a way


def smoothed(values: FloatArray, sigma_m: float) -> FloatArray:
    """Return values along a way (N,) with a Gaussian over their neighbours; the first one stays."""
    reach = round(4 * sigma_m / STEP_M)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * STEP_M / sigma_m) ** 2)
    padded = np.pad(values, (reach, 0), mode="reflect", reflect_type="odd")
    padded = np.pad(padded, (0, reach), mode="edge")
    smooth: FloatArray = np.convolve(padded, kernel / kernel.sum(), mode="valid")
    return smooth
