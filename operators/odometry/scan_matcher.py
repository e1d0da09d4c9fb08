"""Finding a scan's pose in a local map, from a prediction or, where that leads nowhere, by search."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mapstream.operators.lidar.registration import Registration, RegistrationResult
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3

_SEARCH_YAW_DEG = (0.0, 25.0, -25.0, 50.0, -50.0)
_SURE_INLIER_FRACTION = 0.75  # of a good prediction, refined over a short distance


class ScanMatcher:
    """Aligns scans to what it is given as a target, and believes only what fits.

    A fit is believed if enough of the scan's points lie on the target. Where the prediction gives no such
    fit over a short distance, a longer one is tried; then guesses with other headings at a coarse
    resolution, of which the best is refined.
    """

    def __init__(
        self,
        *,
        near: Registration,
        far: Registration,
        coarse: Registration,
        min_inlier_fraction: float,
    ) -> None:
        self._near, self._far, self._coarse = near, far, coarse
        self._min_inlier_fraction = min_inlier_fraction

    def match(
        self, points: FloatArray, target: FloatArray, T_predicted: SE3, T_last: SE3
    ) -> RegistrationResult:
        """Find the pose of points (N, 3) in the target (M, 3).

        Args:
            points: In the base frame [m].
            target: In the odom frame [m].
            T_predicted: Where the base should be.
            T_last: Where it was before, the guess of a body that stopped.

        Raises:
            EstimationError: If no guess leads to a fit, with the best inlier fraction that was seen.
        """
        result = self._near.align(points, target, T_predicted)
        if result.inlier_fraction >= max(_SURE_INLIER_FRACTION, self._min_inlier_fraction):
            return result
        result = self._far.align(points, target, T_predicted)
        if result.inlier_fraction >= self._min_inlier_fraction:
            return result
        tried = [self._coarse.align(points, target, T) for T in _guesses(T_predicted, T_last)]
        best = max(tried, key=lambda found: found.inlier_fraction)
        refined = self._far.align(points, target, best.T_target_source)
        if refined.inlier_fraction >= self._min_inlier_fraction:
            return refined
        most = max(result.inlier_fraction, refined.inlier_fraction)
        raise EstimationError(
            f"inlier fraction {most:.2f}, at least {self._min_inlier_fraction:.2f} needed"
        )


def _guesses(T_predicted: SE3, T_last: SE3) -> Iterator[SE3]:
    for T in (T_predicted, T_last):
        for yaw_deg in _SEARCH_YAW_DEG:
            yield T @ SE3.exp([0, 0, np.radians(yaw_deg), 0, 0, 0])
