"""Where groups of observations say that their points are: means of 3D points, or rays that meet.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section III-A2: 3D observations are averaged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.landmarks.triangulation import Points, Rays, group_sums, triangulate
from mapstream.operators.landmarks.views import Views, views_of
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.columns import TextArray
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

FOUND = "found"
REASONS = ("too few views", "too little parallax", "behind a camera", "rays do not meet")


class LocateConfig(OperatorConfig):
    """When observations determine a point. A 3D point determines itself."""

    min_observations: PositiveInt = 2
    """Rays that a point needs."""
    min_parallax_rad: float = Field(default=float(np.deg2rad(5)), ge=0)
    """The largest angle between two rays, at the point."""
    max_mean_error_sigma: PositiveFloat = 5.0
    """The root mean square of the angles between rays and the point, in units of the keypoints' sigma."""


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Points by group."""

    positions: FloatArray  # (G, 3) in the map frame [m]; NaN where there is none
    covariance: FloatArray  # (G, 3, 3) [m^2]
    outcome: TextArray  # (G,) FOUND or one of REASONS


def locate(map_: Map, rows: IntArray, group: IntArray, config: LocateConfig) -> Located:
    """Return where the points of groups of observations are.

    Args:
        map_: The map.
        rows: Of observations (N,).
        group: Shape (N,), the number of each one's group, not decreasing, from 0, none left out.
        config: When a point is determined.
    """
    views = views_of(map_, rows)
    num = int(group[-1]) + 1 if len(group) else 0
    found = Located(
        np.full((num, 3), np.nan), np.full((num, 3, 3), np.nan), np.full(num, REASONS[0], object)
    )
    is_point: BoolArray = np.asarray(np.isfinite(views.points).all(axis=1))
    has_points = np.zeros(num, bool)
    has_points[group[is_point]] = True
    _average(views.taken(is_point), group[is_point], found)
    is_ray = np.isfinite(views.rays).all(axis=1) & ~has_points[group]
    count = np.bincount(group[is_ray], minlength=num)
    is_ray &= count[group] >= config.min_observations
    _meet(views.taken(is_ray), group[is_ray], config, found)
    return found


def _average(views: Views, group: IntArray, found: Located) -> None:
    """Put 3D points at the mean of their observations, each alike."""
    if not len(group):
        return
    groups = np.unique(group)
    count = group_sums(group, np.ones(len(group)))
    found.positions[groups] = group_sums(group, views.points) / count[:, None]
    variance = group_sums(group, views.point_sigmas_m**2) / count**2
    found.covariance[groups] = variance[:, None, None] * np.eye(3)
    found.outcome[groups] = FOUND


def _meet(views: Views, group: IntArray, config: LocateConfig, found: Located) -> None:
    """Put points where rays meet."""
    groups, number = np.unique(group, return_inverse=True)
    points = triangulate(
        Rays(number, views.T_map_sensor[:, :3, 3], views.rays, views.ray_sigmas_rad)
    )
    outcome = _judged(points, number, views.ray_sigmas_rad, config)
    is_found = outcome == FOUND
    found.outcome[groups] = outcome
    found.positions[groups[is_found]] = points.positions[is_found]
    found.covariance[groups[is_found]] = points.covariance[is_found]


def _judged(points: Points, group: IntArray, sigmas: FloatArray, config: LocateConfig) -> TextArray:
    """Return the outcome (G,) of triangulations; half of the views must have the point in front."""
    num = len(points.positions)
    outcome = np.full(num, FOUND, object)
    if not num:
        return outcome
    count = group_sums(group, np.ones(len(group)))
    squared = np.minimum((points.errors_rad / sigmas) ** 2, 4 * config.max_mean_error_sigma**2)
    error = np.sqrt(group_sums(group, squared) / count)
    in_front = group_sums(group, points.is_in_front.astype(np.float64)) / count
    outcome[~(error <= config.max_mean_error_sigma)] = REASONS[3]
    outcome[in_front <= 0.5] = REASONS[2]
    is_flat = ~(points.parallax_rad >= config.min_parallax_rad)
    is_flat |= ~np.isfinite(points.covariance).all(axis=(1, 2))
    outcome[is_flat] = REASONS[1]
    return outcome
