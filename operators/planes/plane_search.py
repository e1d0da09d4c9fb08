"""Where planes that are seen lie among planes that are known, without a guess.

Pairs of planes that meet at one angle give rotations, of which a room has few; for each of them triples of planes
in general position give shifts, and the pose on which most planes lie within known outlines is the place. Where
another place is nearly as good, as in a room that looks alike from both ends, there is no answer.
Source: Grimson, Lozano-Perez: Localizing overlapping parts by searching the interpretation tree, TPAMI 1987 (pairs
and triples of surfaces by angles and distances).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mapstream.operators.planes.plane_evidence import KnownOutlines, samples_of
from mapstream.operators.planes.plane_pose import PlaneNoise, PlaneSet, pose_from_planes
from mapstream.operators.planes.seen_plane import SeenPlane
from mapstream.recordings.maps.hulls import area_of, common_area_of, moved_hull
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.geometry import SE3, invert

_LEAST_SINE = 0.5  # between planes that give a rotation
_LEAST_VOLUME = 0.3  # determinant of three normals that give a shift
_MOST_TRIPLES = 1500  # by rotation
_MOST_TRIED = 24  # places that are fitted
_ALIKE_RAD, _ALIKE_M = 0.1, 0.15  # rotations and shifts so near are one
_LEAST_WITHIN = 0.1  # of an outline, on a known one


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchLimits:
    """What is taken for a place."""

    angle_rad: float  # between a plane and a known one
    distance_m: float
    min_planes: int
    min_score: float  # of 1
    lead: float  # over the second best place
    noise: PlaneNoise


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A pose that lays planes on known ones."""

    T_map_seen: SE3
    score: float  # share of what is seen that lies on known planes, less what they would hide
    pairs: IntArray  # (N, 2) rows of planes seen and known
    information: FloatArray  # (6, 6)


@dataclass(frozen=True, slots=True, eq=False)
class SearchResult:
    """The place, if there is one, and why not."""

    place: Place | None
    reason: str


def search(
    known: Sequence[SeenPlane],
    seen: Sequence[SeenPlane],
    origins: FloatArray,
    limits: SearchLimits,
    seed: int,
) -> SearchResult:
    """Return where planes that were seen from origins (N, 3) lie among those that are known."""
    if len(seen) < limits.min_planes:
        return SearchResult(None, f"{len(seen)} planes are too few")
    map_set, seen_set = plane_set(known), plane_set(seen)
    outlines, samples = KnownOutlines(known), samples_of(seen, origins)
    reach = {"angle_rad": limits.angle_rad, "distance_m": limits.distance_m}
    rng = np.random.default_rng(seed)
    poses = [
        _shifted(map_set, seen_set, R, samples.weights, limits, rng)
        for R in _rotations(map_set, seen_set, samples.weights, limits)
    ]
    guesses = np.concatenate([np.empty((0, 4, 4)), *poses])
    scores = np.concatenate(
        [
            outlines.scores(samples, part, **reach)
            for part in np.array_split(guesses, len(poses) + 1)
        ]
    )
    tried = [SE3(guesses[row]) for row in np.argsort(-scores, kind="stable")[:_MOST_TRIED]]
    fitted = [place for T in tried if (place := _place(known, seen, T, limits)) is not None]
    if not fitted:
        return SearchResult(None, "no three planes fit the map")
    final = outlines.scores(samples, np.array([each[0].matrix for each in fitted]), **reach)
    places = [
        Place(T, float(score), pairs, information)
        for score, (T, pairs, information) in sorted(
            zip(final.tolist(), fitted, strict=True), key=lambda each: -each[0]
        )
    ]
    return _judged(places, limits)


def _judged(places: Sequence[Place], limits: SearchLimits) -> SearchResult:
    """Return the best place, if it is good enough and no other one is nearly as good."""
    best = places[0]
    others = [p.score for p in places[1:] if _is_other(p.T_map_seen, best.T_map_seen)]
    other = max(others, default=0.0)
    if len(best.pairs) < limits.min_planes or best.score < limits.min_score:
        reason = f"the best place has {len(best.pairs)} planes, score {best.score:.2f}"
        return SearchResult(None, reason)
    if best.score < limits.lead * other:
        reason = f"two places look alike: scores {best.score:.2f} and {other:.2f}"
        return SearchResult(None, reason)
    return SearchResult(best, "accepted")


def plane_set(planes: Sequence[SeenPlane]) -> PlaneSet:
    """Return normals and points of planes."""
    normals = np.array([plane.normal for plane in planes]).reshape(-1, 3)
    return PlaneSet(normals, np.array([plane.middle for plane in planes]).reshape(-1, 3))


def within(known: SeenPlane, seen: SeenPlane, T_known_seen: SE3) -> float:
    """Return what share of a plane's outline lies within that of a known one."""
    T = invert(known.T_frame_plane) @ (T_known_seen.matrix @ seen.T_frame_plane)
    outline = moved_hull(T, seen.hull_m)
    return common_area_of(known.hull_m, outline) / max(area_of(outline), 1e-9)


def _rotations(
    known: PlaneSet, seen: PlaneSet, weights: FloatArray, limits: SearchLimits
) -> list[FloatArray]:
    """Return rotations (3, 3) by which two planes face as two known ones; nearly equal ones once."""
    cosines = known.normals @ known.normals.T
    order = np.argsort(-weights, kind="stable")
    found = np.empty((0, 9))
    for i, j in list(combinations(order.tolist(), 2))[: 2 * len(order)]:
        cosine = seen.normals[i] @ seen.normals[j]
        if np.sqrt(max(1 - cosine**2, 0.0)) < _LEAST_SINE:
            continue
        angles = np.arccos(np.clip(cosines, -1, 1)) - np.arccos(np.clip(cosine, -1, 1))
        rows, columns = np.nonzero(np.abs(angles) < limits.angle_rad)
        axes = _axes(seen.normals[i], seen.normals[j])
        for R in _axes(known.normals[rows], known.normals[columns]) @ axes.T:
            if not (found @ R.ravel() > 1 + 2 * np.cos(_ALIKE_RAD)).any():  # traces of R.T @ other
                found = np.concatenate([found, R.reshape(1, 9)])
    return list(found.reshape(-1, 3, 3))


def _axes(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return axes (..., 3, 3) that two directions (..., 3) span, half of their error on either."""
    x, z = a + b, np.cross(a, b)
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    z = z / np.linalg.norm(z, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _shifted(
    known: PlaneSet,
    seen: PlaneSet,
    R: FloatArray,
    weights: FloatArray,
    limits: SearchLimits,
    rng: np.random.Generator,
) -> FloatArray:
    """Return poses (T, 4, 4) of one rotation, on which three planes lie on known ones, and most others may."""
    is_alike = seen.normals @ R.T @ known.normals.T > np.cos(limits.angle_rad)
    rows, columns = np.nonzero(is_alike)
    normals = known.normals[columns]
    # where a point of the plane that is seen comes to lie on the known one: n.t = ...
    right = -known.offsets[columns] - np.einsum("ni,ni->n", normals, seen.points[rows] @ R.T)
    triples = np.array(list(combinations(range(len(rows)), 3)), dtype=np.int64).reshape(-1, 3)
    if len(triples) > _MOST_TRIPLES:
        triples = triples[rng.choice(len(triples), _MOST_TRIPLES, replace=False)]
    volumes = np.abs(np.linalg.det(normals[triples])) if len(triples) else np.zeros(0)
    triples = triples[volumes > _LEAST_VOLUME]
    if not len(triples):
        return np.empty((0, 4, 4))
    shifts = np.linalg.solve(normals[triples], right[triples][:, :, None])[:, :, 0]
    _, first = np.unique(np.round(shifts / _ALIKE_M), axis=0, return_index=True)
    shifts = shifts[np.sort(first)]
    is_on = np.abs(shifts @ normals.T - right) < limits.distance_m  # (T, pairs)
    shifts = shifts[_any_of(is_on, rows, len(weights)) @ weights >= limits.min_score]
    poses = np.tile(np.eye(4), (len(shifts), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R, shifts
    return poses


def _any_of(is_on: BoolArray, rows: IntArray, count: int) -> BoolArray:
    """Return which planes (T, N) lie on any known one, of which pairs (T, P) do."""
    found = np.zeros((len(is_on), count), dtype=np.bool_)
    for row in range(count):
        found[:, row] = is_on[:, rows == row].any(axis=1)
    return found


def _place(
    known: Sequence[SeenPlane], seen: Sequence[SeenPlane], T_map_seen: SE3, limits: SearchLimits
) -> tuple[SE3, IntArray, FloatArray] | None:
    """Return the pose laid on the known planes, the pairs and the information; None if these leave it open."""
    pairs = matches(known, seen, T_map_seen, limits)
    if len(pairs) < 3:
        return None
    map_set, seen_set = plane_set(known), plane_set(seen)
    T, information = pose_from_planes(
        map_set.chosen(pairs[:, 1]), seen_set.chosen(pairs[:, 0]), T_map_seen, limits.noise
    )
    return (T, pairs, information) if np.linalg.eigvalsh(information)[0] >= 1.0 else None


def matches(
    known: Sequence[SeenPlane], seen: Sequence[SeenPlane], T_map_seen: SE3, limits: SearchLimits
) -> IntArray:
    """Return rows (N, 2) of planes seen and known that a pose lays on each other."""
    map_set, seen_set = plane_set(known), plane_set(seen)
    is_alike = seen_set.normals @ T_map_seen.R.T @ map_set.normals.T > np.cos(limits.angle_rad)
    off = (T_map_seen @ seen_set.points) @ map_set.normals.T + map_set.offsets
    candidates = np.argwhere(is_alike & (np.abs(off) < limits.distance_m))
    is_within = [
        within(known[column], seen[row], T_map_seen) > _LEAST_WITHIN
        for row, column in candidates.tolist()
    ]
    pairs: IntArray = candidates[np.array(is_within, dtype=np.bool_)]
    return pairs


def _is_other(a: SE3, b: SE3) -> bool:
    off = a.inverse() @ b
    return bool(off.angle_rad > 2 * _ALIKE_RAD or np.linalg.norm(off.t) > 2 * _ALIKE_M)
