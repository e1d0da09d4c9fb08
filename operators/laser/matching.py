"""Matching of planar scans by the distances of points from lines.

Each point is compared with the line through its nearest neighbour; Gauss-Newton moves all points at once. Pairs
that are farther apart than the search distance, which shrinks, or look another way, do not count, and those that fit
worse than most count less.
Source: Censi, An ICP variant using a point-to-line metric, ICRA 2008; his covariance: An accurate closed-form
estimate of ICP's covariance, ICRA 2007 (its first term); for directions that nothing observes: Zhang, Kaess, Singh,
On degeneracy of optimization-based state estimation problems, ICRA 2016.
Nothing is kept between calls, so that any number of threads may match at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from mapstream.operators.laser.planar import apply, difference, perturbed, rotation
from mapstream.operators.laser.surfaces import Surface
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError

if TYPE_CHECKING:
    from scipy.spatial import KDTree

_MIN_PAIRS = 8
_MIN_AGREEMENT = 0.7  # cosine between the normals of a pair
_SHRINK = 0.8  # of the search distance, at each step
_NOISE_FLOOR_M = 0.01  # of a range
_CORRELATION = 9.0  # neighbouring beams share their errors: so many count as one
_NORMAL_ERROR_RAD = 0.03  # what lines seem to see along themselves is noise
_CONVERGED = np.array([1e-4, 5e-4, 5e-4])  # [rad, m, m] of a step
_SETTLED = 10.0  # steps so many times as large, where pairs change to and fro, are settled too


@dataclass(frozen=True, slots=True)
class MatchConfig:
    """How pairs are made, and what counts as a fit."""

    search_distance_m: float = 0.5  # of a pair at first
    final_distance_m: float = 0.2  # of a pair at last
    inlier_distance_m: float = 0.08  # from the line
    max_iterations: int = 40


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known of the pose without the scan."""

    pose: FloatArray  # (3,)
    information: FloatArray  # (3, 3) of the tangent


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanMatch:
    """Where a scan fits, and how well. Whether to believe it is the caller's decision."""

    pose: FloatArray  # (3,) of the source in the target's frame
    information: FloatArray  # (3, 3) by the scan alone; singular where it does not see
    inlier_fraction: float  # of the source's points
    rmse_m: float  # of the inliers
    converged: bool

    @property
    def covariance(self) -> FloatArray:
        """Return the covariance (3, 3) of the tangent; infinite on each axis that an unseen direction has part in."""
        return covariance_of(self.information)

    @property
    def score(self) -> float:
        """Rank matches: many inliers, and those close to the lines."""
        return self.inlier_fraction / (1 + 10 * self.rmse_m) if self.converged else 0.0


def covariance_of(information: FloatArray) -> FloatArray:
    """Return the inverse of an information matrix (N, N); infinite variances where it is singular."""
    eigenvalues, vectors = np.linalg.eigh(information)
    seen = eigenvalues > 1e-9 * max(eigenvalues[-1], 1e-9)
    covariance: FloatArray = (vectors[:, seen] / eigenvalues[seen]) @ vectors[:, seen].T
    is_open = (np.abs(vectors[:, ~seen]) > 1e-3).any(axis=1)
    covariance[is_open] = covariance[:, is_open] = 0.0
    covariance[is_open, is_open] = np.inf
    return covariance


class LineTarget:
    """A surface to match to, with its search tree."""

    def __init__(self, surface: Surface) -> None:
        self.surface = surface.lined()

    @cached_property
    def tree(self) -> KDTree:
        from scipy.spatial import KDTree  # noqa: PLC0415  # slow to import

        return KDTree(self.surface.points)


def match(
    source: Surface,
    target: LineTarget,
    guess: FloatArray,
    config: MatchConfig | None = None,
    prior: Prior | None = None,
) -> ScanMatch:
    """Find the pose of the source in the target's frame.

    Along a direction that the scan does not see, the pose stays that of the prior, or that of the guess.

    Args:
        source: A scan, in its own frame.
        target: What it is compared with.
        guess: (3,) where to begin.
        config: How to match.
        prior: What else is known; weighed with the scan.

    Raises:
        EstimationError: If one of the two has too few points.
    """
    config = config or MatchConfig()
    if min(len(source), len(target.surface)) < _MIN_PAIRS:
        raise EstimationError(
            f"scans of {len(source)} points and {len(target.surface)} on lines cannot be matched;"
            f" at least {_MIN_PAIRS} are needed"
        )
    pose, distance_m = guess.astype(np.float64), config.search_distance_m
    pairs = _pairs(source, target, pose, distance_m)
    step = np.full(3, np.inf)
    for _ in range(config.max_iterations):
        if pairs.num < _MIN_PAIRS:
            break
        step = _step(pairs, pose, prior)
        pose = perturbed(pose, step)
        is_last = distance_m <= config.final_distance_m
        distance_m = max(_SHRINK * distance_m, config.final_distance_m)
        pairs = _pairs(source, target, pose, distance_m)
        if is_last and (np.abs(step) < _CONVERGED).all():
            break
    settled = bool((np.abs(step) < _SETTLED * _CONVERGED).all())
    return _judged(pairs, pose, config, num_points=len(source), converged=settled)


def fit(source: Surface, target: LineTarget, pose: FloatArray, config: MatchConfig) -> ScanMatch:
    """Return how well the source fits where it is; it is not moved."""
    pairs = _pairs(source, target, pose, config.final_distance_m)
    return _judged(pairs, pose, config, num_points=len(source), converged=True)


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Points and the lines nearest to them."""

    residuals: FloatArray  # (M,) [m] across the line
    across: FloatArray  # (M, 3) their derivatives by the tangent
    along: FloatArray  # (M, 3) what they would be with the lines turned by a right angle

    @property
    def num(self) -> int:
        return len(self.residuals)


def _pairs(source: Surface, target: LineTarget, pose: FloatArray, distance_m: float) -> _Pairs:
    moved, R = apply(pose, source.points), rotation(pose[2])
    nearest_m, at = target.tree.query(moved, distance_upper_bound=distance_m)
    found = np.flatnonzero(np.isfinite(nearest_m))
    at, points = at[found], source.points[found]
    normals = target.surface.normals[at] @ R  # in the source's frame
    agreement = np.einsum("nc,nc->n", normals, source.normals[found])
    if not (source.has_sides and target.surface.has_sides):
        agreement = np.abs(agreement)
    keep = ~(agreement < _MIN_AGREEMENT)  # a point without a line agrees with all
    normals, points = normals[keep], points[keep]
    gaps = (moved[found[keep]] - target.surface.points[at[keep]]) @ R
    tangents = np.stack([-normals[:, 1], normals[:, 0]], axis=-1)
    return _Pairs(
        np.einsum("nc,nc->n", normals, gaps),
        _jacobian(points, normals),
        _jacobian(points, tangents),
    )


def _jacobian(points: FloatArray, axes: FloatArray) -> FloatArray:
    """Return how the parts of points (N, 2) along axes (N, 2) change with the tangent."""
    lever = points[:, 0] * axes[:, 1] - points[:, 1] * axes[:, 0]
    return np.concatenate([lever[:, None], axes], axis=1)


def _step(pairs: _Pairs, pose: FloatArray, prior: Prior | None) -> FloatArray:
    """Return the tangent to go by: the scan's own step, weighed with the prior by what each of them knows."""
    scale_m = max(1.4826 * float(np.median(np.abs(pairs.residuals))), _NOISE_FLOOR_M)
    weights = 1 / (1 + (pairs.residuals / (2 * scale_m)) ** 2)  # Cauchy's
    information = _information(pairs, weights, scale_m)
    hessian = pairs.across.T @ (weights[:, None] * pairs.across)
    gradient = pairs.across.T @ (weights * pairs.residuals)
    own = -np.linalg.lstsq(hessian, gradient, rcond=1e-9)[0]
    if prior is None:
        return np.asarray(np.linalg.lstsq(information, information @ own, rcond=1e-9)[0])
    wanted = information @ own + prior.information @ difference(pose, prior.pose)
    return np.asarray(np.linalg.solve(information + prior.information, wanted))


def _information(pairs: _Pairs, weights: FloatArray, scale_m: float) -> FloatArray:
    """Return what the scan knows (3, 3), less what lines that were fitted badly only seem to know."""
    reach_m = np.sqrt(max(float(np.mean(pairs.across[:, 0] ** 2 + pairs.along[:, 0] ** 2)), 1e-6))
    units = np.array([1 / reach_m, 1.0, 1.0])  # turns as metres at the mean range
    across, along = pairs.across * units, pairs.along * units
    seen = across.T @ (weights[:, None] * across)
    seen -= _NORMAL_ERROR_RAD**2 * along.T @ (weights[:, None] * along)
    known, axes = np.linalg.eigh(seen)
    known = np.maximum(known, 0.0) / (_CORRELATION * scale_m**2)
    information: FloatArray = (axes * known) @ axes.T / np.outer(units, units)
    return information


def _judged(
    pairs: _Pairs, pose: FloatArray, config: MatchConfig, *, num_points: int, converged: bool
) -> ScanMatch:
    is_inlier = np.abs(pairs.residuals) < config.inlier_distance_m
    inliers = _Pairs(pairs.residuals[is_inlier], pairs.across[is_inlier], pairs.along[is_inlier])
    if inliers.num < _MIN_PAIRS:
        nothing = np.zeros((3, 3))
        return ScanMatch(
            pose=pose, information=nothing, inlier_fraction=0.0, rmse_m=np.inf, converged=False
        )
    rmse_m = float(np.sqrt(np.mean(inliers.residuals**2)))
    return ScanMatch(
        pose=pose,
        information=_information(inliers, np.ones(inliers.num), max(rmse_m, _NOISE_FLOOR_M)),
        inlier_fraction=inliers.num / num_points,
        rmse_m=rmse_m,
        converged=converged,
    )
