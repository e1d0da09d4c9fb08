"""Matching the surroundings of two keyframes whose relative pose is only roughly known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.lidar.registration import Points, Registration, RegistrationResult
from mapstream.streams.geometry import SE3

_DIRECTIONS = 6  # of the first ring of starts; twice as many in the second
_MAX_RINGS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """What a match must be to be believed."""

    min_inlier_fraction: float
    max_rmse_m: float
    max_turn_rad: float  # away from the guess
    max_sigma_m: float = np.inf  # of the position along its least certain direction

    def refusal(self, result: RegistrationResult, T_guess: SE3, max_shift_m: float) -> str | None:
        """Return why a match is not believed, or None if it is."""
        return self.misfit(result) or self._too_far(result, T_guess, max_shift_m)

    def misfit(self, result: RegistrationResult) -> str | None:
        """Return why a match is not believed wherever it was expected, or None."""
        if not result.converged:
            return "the registration did not converge"
        if result.inlier_fraction < self.min_inlier_fraction:
            return f"inlier fraction {result.inlier_fraction:.2f} < {self.min_inlier_fraction:.2f}"
        if result.rmse_m > self.max_rmse_m:
            return f"rmse {result.rmse_m:.3f} m > {self.max_rmse_m:.3f} m"
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(result.covariance[3:, 3:])[-1]))
        if sigma_m > self.max_sigma_m:
            return f"nothing holds the position along one direction: sigma {sigma_m:.2f} m"
        return None

    def _too_far(self, result: RegistrationResult, T_guess: SE3, max_shift_m: float) -> str | None:
        moved = T_guess.inverse() @ result.T_target_source
        if np.linalg.norm(moved.t) > max_shift_m:
            return f"{np.linalg.norm(moved.t):.2f} m from the guess, more than {max_shift_m:.2f} m"
        if moved.angle_rad > self.max_turn_rad:
            return f"{np.degrees(moved.angle_rad):.1f} deg from the guess"
        return None


class LoopMatcher:
    """Finds the best of many starts at a coarse resolution, and refines it.

    In a corridor the walls fit wherever one stands in it, so the first fit that looks good is not good
    enough: starts on a grid around the guess compete.
    """

    def __init__(self, fine: Registration, coarse: Registration, grid_m: float) -> None:
        self._fine, self._coarse, self._grid_m = fine, coarse, grid_m

    def match(
        self, source: Points, target: Points, T_guess: SE3, radius_m: float
    ) -> RegistrationResult:
        """Find T_target_source within about `radius_m` of the guess.

        Raises:
            EstimationError: If one of the clouds is too small to be registered.
        """
        tried = [self._coarse.align(source, target, T) for T in self._starts(T_guess, radius_m)]
        return self._fine.align(source, target, max(tried, key=score).T_target_source)

    def refine(self, source: Points, target: Points, T_guess: SE3) -> RegistrationResult:
        """Find T_target_source close to the guess.

        Raises:
            EstimationError: If one of the clouds is too small to be registered.
        """
        return self._fine.align(source, target, T_guess)

    def _starts(self, T_guess: SE3, radius_m: float) -> list[SE3]:
        starts = [T_guess]
        for ring in range(1, min(int(radius_m / self._grid_m), _MAX_RINGS) + 1):
            for k in range(_DIRECTIONS * ring):
                angle = 2 * np.pi * k / (_DIRECTIONS * ring)
                shift = ring * self._grid_m * np.array([np.cos(angle), np.sin(angle), 0.0])
                starts.append(SE3.from_rotation(T_guess.R, T_guess.t + shift))
        return starts


def score(result: RegistrationResult) -> float:
    """Rank matches: many inliers, and those close to the surface."""
    return result.inlier_fraction / (1 + result.rmse_m) if result.converged else 0.0
