"""How finely to sample: a corridor wants centimetres, a street half a metre."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import FloatArray

_PER_RANGE = 0.04  # of the median range: 8 m of room give 0.3 m
_FINEST_M, _COARSEST_M = 0.1, 0.5
_HYSTERESIS = 1.5  # small changes of the surroundings leave the size as it is


class Resolution:
    """A voxel size that follows the surroundings, or a fixed one."""

    def __init__(self, fixed_m: float | None) -> None:
        self._fixed_m = fixed_m
        self._current_m = 0.0

    def update(self, points: FloatArray) -> float:
        """Return the voxel size [m] for a scan of points (N, 3) around the sensor."""
        if self._fixed_m is not None:
            return self._fixed_m
        if len(points):
            median_m = float(np.median(np.linalg.norm(points, axis=1)))
            wanted_m = float(np.clip(_PER_RANGE * median_m, _FINEST_M, _COARSEST_M))
            is_near = self._current_m / _HYSTERESIS < wanted_m < self._current_m * _HYSTERESIS
            self._current_m = self._current_m if is_near else wanted_m
        return self._current_m or _COARSEST_M
