"""How what a planar laser saw at two places lies to each other: coarsely on a likelihood grid, then by lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.laser.correlative import LikelihoodGrid, Window
from mapstream.operators.laser.matching import LineTarget, MatchConfig, fit, match
from mapstream.operators.laser.planar import flattened, lifted, lifted_covariance
from mapstream.operators.laser.recent_scans import first_in_cells
from mapstream.operators.laser.surfaces import Surface, surface_of_cloud
from mapstream.operators.lidar.registration import Points, RegistrationResult
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3

_MIN_POINTS = 30
_MAX_SIGMA_M = 0.3  # of the position along an axis; a corridor does not say where in it one is


@dataclass(frozen=True, slots=True)
class PlanarMatcher:
    """Matches clouds that lie flat, for the search of loops.

    Clouds (N, 3) are in base frames whose z axes are parallel; heights do not count.
    """

    turn_rad: float  # how far from the guess to look
    overlap_radius_m: float  # only points so near the robot must fit: both times they were in sight
    cell_m: float  # one point is taken in each
    config: MatchConfig
    ground_sigma_rad: float  # of roll and pitch, which a planar laser does not see
    ground_sigma_m: float  # of z

    def match(
        self, source: Points, target: Points, T_guess: SE3, radius_m: float
    ) -> RegistrationResult:
        """Find T_target_source within about `radius_m` of the guess, as `PlaceMatcher`."""
        points, lines = self._thinned(source), LineTarget(surface_of_cloud(self._thinned(target)))
        window = Window(radius_m=radius_m, turn_rad=self.turn_rad)
        basin = LikelihoodGrid(lines.surface.points).search(points, flattened(T_guess), window)
        return self._refined(surface_of_cloud(points), lines, basin.pose)

    def refine(self, source: Points, target: Points, T_guess: SE3) -> RegistrationResult:
        """Find T_target_source close to the guess, as `PlaceMatcher`."""
        surfaces = [surface_of_cloud(self._thinned(cloud)) for cloud in (source, target)]
        return self._refined(surfaces[0], LineTarget(surfaces[1]), flattened(T_guess))

    def _thinned(self, cloud: Points) -> FloatArray:
        points = np.asarray(cloud, np.float64)[:, :2]
        points = points[first_in_cells(points, self.cell_m)]
        if len(points) < _MIN_POINTS:
            raise EstimationError(
                f"a place of {len(points)} points cannot be matched; {_MIN_POINTS} are needed"
            )
        return points

    def _refined(
        self, source: Surface, target: LineTarget, guess: FloatArray
    ) -> RegistrationResult:
        found = match(source, target, guess, self.config)
        covariance = found.covariance
        sigma_m = float(np.sqrt(np.diagonal(covariance)[1:].max()))
        if not sigma_m < _MAX_SIGMA_M or not np.isfinite(covariance[0, 0]):
            raise EstimationError(
                f"the place leaves a direction open: the position is known to {sigma_m:.2f} m"
            )
        near = source.within(self.overlap_radius_m)
        fitting = fit(near, target, found.pose, self.config)
        return RegistrationResult(
            T_target_source=lifted(found.pose),
            covariance=lifted_covariance(covariance, self.ground_sigma_rad, self.ground_sigma_m),
            inlier_fraction=fitting.inlier_fraction,
            rmse_m=fitting.rmse_m,
            converged=found.converged,
        )
