"""Where one thing is that several detections show: the mean of its 3D points, or where the rays to it meet.

The middle of a box is not quite the image of the middle of the thing, and trackers sometimes follow another one:
places are found by consensus, and what does not agree is left out.
Source of the consensus: Fischler and Bolles, Random Sample Consensus, Communications of the ACM 1981.
"""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import blake2b

import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.landmarks.locating import FOUND, REASONS
from mapstream.operators.landmarks.triangulation import Points, Rays, triangulate
from mapstream.operators.objects.landmarks.sightings import Sightings
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

_MAX_PAIRS = 300  # of rays that are tried
_MAX_ROUNDS = 8
_SAME_SIDE = (
    0.1  # of its size: so far off are the middles of a thing that is seen from one side only
)
_PARALLEL = 1e-5  # square of the sine


class PlacingConfig(OperatorConfig):
    """When detections determine a place."""

    min_observations: PositiveInt = 3
    """Images in which a thing must have been seen."""
    min_parallax_rad: float = Field(default=float(np.deg2rad(5)), ge=0)
    """The largest angle between two rays, at the thing; 3D points need none."""
    max_error_sigma: PositiveFloat = 3.0
    """Farther off, a detection is of something else."""
    min_share: float = Field(default=0.2, gt=0, le=1)
    """Of the detections of a track, so many must agree."""
    max_sigma_m: PositiveFloat = 0.5
    """Along its worst direction; a place that is less sure is none."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A thing's place in the map frame."""

    outcome: str  # FOUND, or why there is no place
    position: FloatArray  # (3,) [m]; NaN where there is none
    covariance: FloatArray  # (3, 3) [m^2]
    size_m: float  # how large it looks
    members: IntArray  # (M,) of the sightings, that agree


def key_of(members: IntArray) -> bytes:
    """Return 16 bytes that name a set of sightings; the sets themselves would fill memory."""
    return blake2b(members.tobytes(), digest_size=16).digest()


class Places:
    """The places of things that sightings show; each is found once."""

    def __init__(self, sightings: Sightings, config: PlacingConfig) -> None:
        self._sightings, self._config = sightings, config
        self._found: dict[bytes, Place] = {}

    def of(self, members: IntArray) -> Place:
        """Return the place of the thing that some of the sightings show, by their numbers in order."""
        key = key_of(members)
        if key not in self._found:
            self._found[key] = _placed(self._sightings, members, self._config)
        return self._found[key]


def _placed(sightings: Sightings, members: IntArray, config: PlacingConfig) -> Place:
    views = sightings.views.taken(members)
    is_point: BoolArray = np.asarray(np.isfinite(views.points).all(axis=1))
    is_ray: BoolArray = np.asarray(np.isfinite(views.rays).all(axis=1))
    distance_m = np.linalg.norm(views.points - views.T_map_sensor[:, :3, 3], axis=1)
    if is_point.any():
        size_m = _size_m(sightings, members[is_point], distance_m[is_point])
        sigmas_m = np.hypot(views.point_sigmas_m[is_point], _SAME_SIDE * size_m)
        found = _mean(views.points[is_point], sigmas_m, config)
        return _judged(found, members, np.flatnonzero(is_point), size_m, config)
    if is_ray.sum() < 2:
        return _nowhere(REASONS[0], members)
    rays = Rays(
        np.zeros(int(is_ray.sum()), np.int64),
        views.T_map_sensor[is_ray, :3, 3],
        views.rays[is_ray],
        views.ray_sigmas_rad[is_ray],
    )
    found = _meeting(rays, config)
    distance_m = np.linalg.norm(found.position - rays.origins, axis=1)
    agree = found.agree
    size_m = _size_m(sightings, members[is_ray][agree], distance_m[agree])
    return _judged(found, members, np.flatnonzero(is_ray), size_m, config)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    position: FloatArray
    covariance: FloatArray
    agree: BoolArray
    parallax_rad: float  # pi, where it does not matter


def _mean(points: FloatArray, sigmas_m: FloatArray, config: PlacingConfig) -> _Found:
    """Return the weighted mean of all points (N, 3) if they agree, otherwise of those that agree with their middle."""
    weights = 1 / sigmas_m**2
    agree = np.ones(len(points), np.bool_)
    position = np.average(points, axis=0, weights=weights)
    for turn in range(_MAX_ROUNDS):
        error = np.linalg.norm(points - position, axis=1) / sigmas_m
        now = error <= max(config.max_error_sigma, float(error.min()))
        if (now == agree).all():
            break
        if turn == 0:
            position = np.median(points, axis=0)
            continue
        agree = now
        position = np.average(points[agree], axis=0, weights=weights[agree])
    return _Found(position, np.eye(3) / weights[agree].sum(), agree, np.pi)


def _meeting(rays: Rays, config: PlacingConfig) -> _Found:
    """Return where all rays meet if they do, otherwise where most of them do."""
    agree = np.ones(len(rays.group), np.bool_)
    found = triangulate(rays)
    for turn in range(_MAX_ROUNDS):
        now = _agreeing(rays, found.positions[0], config)
        if (now == agree).all():
            break
        agree = _agreeing(rays, _start(rays, config), config) if turn == 0 else now
        if agree.sum() < 2:
            nan = np.full((3, 3), np.nan)
            return _Found(nan[0], nan, agree, 0.0)
        found = triangulate(_taken(rays, agree))
    return _Found(found.positions[0], found.covariance[0], agree, _parallax(found))


def _parallax(found: Points) -> float:
    is_sure = np.isfinite(found.covariance[0]).all()
    return float(found.parallax_rad[0]) if is_sure else 0.0


def _start(rays: Rays, config: PlacingConfig) -> FloatArray:
    """Return the point (3,), of those where two rays come nearest to each other, that most rays pass."""
    first, second = np.triu_indices(len(rays.group), 1)
    if len(first) > _MAX_PAIRS:
        few = np.random.default_rng(0).choice(len(first), _MAX_PAIRS, replace=False)
        first, second = first[few], second[few]
    points = _midpoints(rays, first, second)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return np.full(3, np.nan)
    errors = _errors(rays, points)
    cost = np.minimum(errors, config.max_error_sigma) ** 2
    best: FloatArray = points[cost.sum(axis=1).argmin()]
    return best


def _midpoints(rays: Rays, first: IntArray, second: IntArray) -> FloatArray:
    """Return the points (K, 3) half way between two rays where they are nearest; NaN of parallel ones."""
    a, b = rays.directions[first], rays.directions[second]
    between = rays.origins[second] - rays.origins[first]
    cosine = np.einsum("ki,ki->k", a, b)
    to_a, to_b = np.einsum("ki,ki->k", between, a), np.einsum("ki,ki->k", between, b)
    sine2 = 1 - cosine**2
    sine2 = np.where(sine2 > _PARALLEL, sine2, np.nan)
    s, t = (to_a - cosine * to_b) / sine2, (cosine * to_a - to_b) / sine2
    ends = rays.origins[first] + s[:, None] * a, rays.origins[second] + t[:, None] * b
    middle: FloatArray = (ends[0] + ends[1]) / 2
    return middle


def _errors(rays: Rays, points: FloatArray) -> FloatArray:
    """Return the angles (K, N) between rays and the directions to points (K, 3), in sigma; behind is far off."""
    away = points[:, None] - rays.origins
    along = np.einsum("knj,nj->kn", away, rays.directions)
    across = np.linalg.norm(away - along[..., None] * rays.directions, axis=2)
    angle: FloatArray = np.arctan2(across, along) / rays.sigmas_rad
    return angle


def _agreeing(rays: Rays, point: FloatArray, config: PlacingConfig) -> BoolArray:
    agree: BoolArray = _errors(rays, point[None])[0] <= config.max_error_sigma
    return agree


def _taken(rays: Rays, chosen: BoolArray) -> Rays:
    return Rays(
        rays.group[chosen], rays.origins[chosen], rays.directions[chosen], rays.sigmas_rad[chosen]
    )


def _size_m(sightings: Sightings, members: IntArray, distance_m: FloatArray) -> float:
    """Return how large a thing is across: what the border cuts shows less than all of it.

    It is 0 where nobody knows, for want of a calibration.
    """
    seen_m = np.sqrt(sightings.sides_rad[members].clip(min=0).prod(axis=1)) * distance_m
    is_known = np.isfinite(seen_m)
    members, seen_m = members[is_known], seen_m[is_known]
    if not len(members):
        return 0.0
    is_whole = ~sightings.is_cut[members]
    return float(np.median(seen_m[is_whole]) if is_whole.any() else seen_m.max())


def _judged(
    found: _Found, members: IntArray, judged: IntArray, size_m: float, config: PlacingConfig
) -> Place:
    """Return the place, if enough detections agree on it; those that could not be judged stay with it."""
    share = found.agree.mean()
    kept = np.ones(len(members), np.bool_)
    kept[judged] = found.agree
    if share < config.min_share:
        return _nowhere(REASONS[3], members)
    if not found.parallax_rad >= config.min_parallax_rad:
        return _nowhere(REASONS[1], members)
    covariance = found.covariance + (_SAME_SIDE * size_m) ** 2 * np.eye(3)
    if not np.linalg.eigvalsh(covariance)[-1] <= config.max_sigma_m**2:
        return _nowhere(REASONS[1], members)
    return Place(FOUND, found.position, covariance, size_m, members[kept])


def _nowhere(reason: str, members: IntArray) -> Place:
    return Place(reason, np.full(3, np.nan), np.full((3, 3), np.nan), float("nan"), members)
