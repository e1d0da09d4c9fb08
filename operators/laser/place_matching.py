"""How what a planar laser saw at two places lies to each other: coarsely on a likelihood grid, then by lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.laser.correlative import LikelihoodGrid, Window
from mapstream.operators.laser.matching import LineTarget, MatchConfig, ScanMatch, match
from mapstream.operators.laser.planar import flattened, lifted, lifted_covariance
from mapstream.operators.laser.recent_scans import first_in_cells
from mapstream.operators.laser.surfaces import Surface, surface_of_cloud
from mapstream.operators.lidar.registration import Points, RegistrationResult
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3

_MIN_POINTS = 30
_MAX_SIGMA_M = (
    0.3  # along the least certain direction: more is a corridor that says not where in it one is
)


@dataclass(frozen=True, slots=True)
class PlanarMatcher:
    """Matches clouds that lie flat, for the search of loops.

    Clouds (N, 3) are in base frames whose z axes are parallel; heights do not count.
    """

    turn_rad: float  # how far from the guess to look
    cell_m: float  # one point is taken in each
    config: MatchConfig
    ground_sigma_rad: float  # of roll and pitch, which a planar laser does not see
    ground_sigma_m: float  # of z

    def match(
        self, source: Points, target: Points, T_guess: SE3, radius_m: float
    ) -> RegistrationResult:
        """Find T_target_source within about `radius_m` of the guess, as `PlaceMatcher`."""
        points, surface = self._thinned(source), self._surface(target)
        window = Window(radius_m=radius_m, turn_rad=self.turn_rad)
        basin = LikelihoodGrid(surface.points).search(points, flattened(T_guess), window)
        return self._result(
            match(self._surface(source), LineTarget(surface), basin.pose, self.config)
        )

    def refine(self, source: Points, target: Points, T_guess: SE3) -> RegistrationResult:
        """Find T_target_source close to the guess, as `PlaceMatcher`."""
        surface = LineTarget(self._surface(target))
        return self._result(match(self._surface(source), surface, flattened(T_guess), self.config))

    def _thinned(self, cloud: Points) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        points = np.asarray(cloud, np.float64)[:, :2]
        points = points[first_in_cells(points, self.cell_m)]
        if len(points) < _MIN_POINTS:
            raise EstimationError(
                f"a place of {len(points)} points cannot be matched; {_MIN_POINTS} are needed"
            )
        return points

    def _surface(self, cloud: Points) -> Surface:
        return surface_of_cloud(self._thinned(cloud))

    def _result(self, found: ScanMatch) -> RegistrationResult:
        covariance = found.covariance
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[1:, 1:])[-1]))
        if not np.isfinite(covariance).all() or sigma_m > _MAX_SIGMA_M:
            raise EstimationError(
                f"the place does not hold the position along one direction: sigma {sigma_m:.2f} m"
            )
        return RegistrationResult(
            T_target_source=lifted(found.pose),
            covariance=lifted_covariance(covariance, self.ground_sigma_rad, self.ground_sigma_m),
            inlier_fraction=found.inlier_fraction,
            rmse_m=found.rmse_m,
            converged=found.converged,
        )
