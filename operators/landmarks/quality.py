"""Which landmarks are good: seen often enough, from different sides, from near enough, and where they should be.

Source: maplab's command evaluate_landmark_quality (elq), whose thresholds are the defaults.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.landmarks.triangulation import widest_angles
from mapstream.operators.landmarks.views import (
    T_map_sensor_of,
    reprojection_errors_px,
    views_of,
)
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray


class RayQuality(OperatorConfig):
    """Of landmarks that were seen along rays alone."""

    min_observers: PositiveInt = 4
    """Two suffice for a map of sparse keyframes."""
    min_parallax_rad: NonNegativeFloat = float(np.deg2rad(5))
    min_distance_m: NonNegativeFloat = 0.05
    """Of the nearest observer."""
    max_distance_m: PositiveFloat = 40.0
    max_reprojection_error_px: PositiveFloat | None = None
    """Of any observation; left out, errors do not matter."""


class PointQuality(OperatorConfig):
    """Of landmarks that were seen as 3D points, by LiDAR or depth."""

    min_observers: PositiveInt = 1
    min_distance_m: NonNegativeFloat = 1.0
    max_distance_m: PositiveFloat = 60.0
    max_error_m: PositiveFloat | None = None
    """Of any observation; left out, errors do not matter."""


class QualityConfig(OperatorConfig):
    """When a landmark is good."""

    rays: RayQuality = Field(default_factory=RayQuality)
    points: PointQuality = Field(default_factory=PointQuality)


@dataclass(frozen=True, slots=True, kw_only=True)
class QualityReport:
    """How many landmarks are of each quality."""

    num: dict[str, int]
    failed: dict[str, int]  # criteria that bad landmarks did not meet; several may fail for one


def evaluate_quality(map_: Map, config: QualityConfig | None = None) -> tuple[Map, QualityReport]:
    """Return the map with the quality of each point that has observations; others keep theirs.

    Objects are no points: `object_landmarks` judges them, and from how near they are seen says nothing against them.
    """
    config = config or QualityConfig()
    facts = _facts(map_, config)
    is_judged = (facts.count > 0) & (map_.landmarks.kind != "object")
    failed: Counter[str] = Counter()
    is_bad = np.zeros(len(map_.landmarks), bool)
    for name, misses in _misses(facts, config).items():
        fails = misses & is_judged
        failed[name] = int(fails.sum())
        is_bad |= fails
    quality = map_.landmarks.quality.copy()
    quality[is_judged] = "good"
    quality[is_bad] = "bad"
    judged = replace(map_, landmarks=replace(map_.landmarks, quality=quality))
    counts = Counter(quality.tolist())
    missed = {name: number for name, number in failed.items() if number}
    return judged, QualityReport(num=dict(sorted(counts.items())), failed=missed)


def reset_quality(map_: Map) -> tuple[Map, int]:
    """Return the map with landmarks of unknown quality, and how many had another one."""
    quality = np.full(len(map_.landmarks), "unknown", dtype=object)
    num = int((map_.landmarks.quality != "unknown").sum())
    return replace(map_, landmarks=replace(map_.landmarks, quality=quality)), num


@dataclass(frozen=True, slots=True, eq=False)
class _Facts:
    """What is known of each landmark (L,)."""

    count: IntArray  # of observations
    is_point: BoolArray  # seen as a 3D point at least once
    parallax_rad: FloatArray
    nearest_m: FloatArray
    error_px: FloatArray  # the largest; 0 where it does not matter
    error_m: FloatArray


def _facts(map_: Map, config: QualityConfig) -> _Facts:
    seen, num = map_.observations.landmark, len(map_.landmarks)
    rows = np.flatnonzero(seen >= 0)
    rows = rows[np.argsort(seen[rows], kind="stable")]
    landmark = seen[rows]
    observer = T_map_sensor_of(map_, rows)[:, :3, 3]
    p_map = map_.T_map_landmark(np.arange(num))[:, :3, 3]
    away = p_map[landmark] - observer
    nearest_m, parallax_rad = np.full(num, np.inf), np.zeros(num)
    np.minimum.at(nearest_m, landmark, np.linalg.norm(away, axis=1))
    groups, group = np.unique(landmark, return_inverse=True)
    if len(groups):
        parallax_rad[groups] = widest_angles(group, away)
    is_point = np.zeros(num, bool)
    is_point[landmark[np.isfinite(map_.observations.p_sensor[rows]).all(axis=1)]] = True
    error_px, error_m = np.zeros(num), np.zeros(num)
    if config.rays.max_reprojection_error_px is not None:
        np.fmax.at(error_px, landmark, reprojection_errors_px(map_, rows))
    if config.points.max_error_m is not None:
        misses_m = np.linalg.norm(views_of(map_, rows).points - p_map[landmark], axis=1)
        np.fmax.at(error_m, landmark, misses_m)
    count = np.bincount(landmark, minlength=num)
    return _Facts(count, is_point, parallax_rad, nearest_m, error_px, error_m)


def _misses(facts: _Facts, config: QualityConfig) -> dict[str, BoolArray]:
    """Return which landmarks (L,) do not meet each criterion."""
    rays, points = config.rays, config.points
    is_ray = ~facts.is_point

    def by_kind(of_rays: float, of_points: float) -> FloatArray:
        return np.where(facts.is_point, of_points, of_rays)

    most_px = rays.max_reprojection_error_px or np.inf
    most_m = points.max_error_m or np.inf
    return {
        "observers": facts.count < by_kind(rays.min_observers, points.min_observers),
        "parallax": is_ray & (facts.parallax_rad < rays.min_parallax_rad),
        "too near": facts.nearest_m < by_kind(rays.min_distance_m, points.min_distance_m),
        "too far": facts.nearest_m > by_kind(rays.max_distance_m, points.max_distance_m),
        "reprojection error": is_ray & (facts.error_px > most_px),
        "3D error": facts.is_point & (facts.error_m > most_m),
    }
