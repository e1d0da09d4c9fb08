"""Projections of descriptors that are learnt from a map: for less memory, and for an index of bits.

Sources: Cramariuc et al., maplab 2.0, RA-L 2023, section III-B (principal components of learned features);
Lynen et al., Placeless place-recognition, 3DV 2014, section 3, after Bosse and Zlot, RAS 2009 (directions in which
descriptors of different points differ more than those of one).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import PositiveInt

from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.features import descriptor_block, descriptors_of
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.projections import (
    DescriptorProjection,
    as_numbers,
    projections_of,
    with_projection,
)
from mapstream.streams.arrays import Float32Array, FloatArray, IntArray
from mapstream.streams.errors import MapError

_SEED = 1
_MIN_PAIRS = 100  # to learn from
_RIDGE = 1.0  # of the mean variance, added to what descriptors of one point differ by


class CompressConfig(OperatorConfig):
    """Options of `compress-descriptors`."""

    kind: str = ""
    """Of the features: sift, superpoint ...; all whose descriptors are numbers where none is said."""
    dimensions: PositiveInt = 32
    """Numbers that stay of each descriptor."""
    max_samples: PositiveInt = 50_000
    """Descriptors from which is learnt."""


class TrainProjectionConfig(OperatorConfig):
    """Options of `train-projection`."""

    kind: str = ""
    """Of the features: brisk, orb ...; all whose descriptors are bits where none is said."""
    dimensions: PositiveInt = 10
    """Numbers to which descriptors are projected; even, for a multi-index."""
    max_pairs: PositiveInt = 50_000
    """Pairs of descriptors of one point, and as many of two, from which is learnt."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compression:
    """What was compressed of one kind."""

    kind: str
    num_descriptors: int
    num_bytes_before: int
    num_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Training:
    """What was learnt of one kind."""

    kind: str
    num_pairs: int
    separation: (
        float  # squared length of differences of two points over those of one, not learnt from
    )


@dataclass(frozen=True, slots=True)
class CompressReport:
    """What was compressed."""

    kinds: tuple[Compression, ...]

    def lines(self) -> list[str]:
        """Return what to tell people."""
        return [
            f"{each.num_descriptors} descriptors of kind {each.kind}: "
            f"{each.num_bytes / 1e6:.1f} MB instead of {each.num_bytes_before / 1e6:.1f} MB"
            for each in self.kinds
        ] or ["no kind has descriptors that are numbers"]


@dataclass(frozen=True, slots=True)
class TrainReport:
    """What was learnt."""

    kinds: tuple[Training, ...]

    def lines(self) -> list[str]:
        """Return what to tell people."""
        return [
            f"{each.kind}: from {each.num_pairs} pairs; two points differ {each.separation:.1f} times"
            " as much as one"
            for each in self.kinds
        ] or ["no kind has descriptors that are bits"]


def compress_descriptors(map_: Map, config: CompressConfig) -> tuple[Map, CompressReport]:
    """Return the map with descriptors projected onto their principal components, and what that saved.

    What was learnt stays with the map: descriptors that came after are projected as those before.

    Raises:
        MapError: If there are no such descriptors, or too few of them or too few numbers in each.
    """
    done = []
    for kind in _kinds(map_, config.kind, "float32"):
        projection = projections_of(map_, "compression").get(kind) or _learnt(map_, kind, config)
        map_, compression = _compressed(with_projection(map_, projection), projection)
        done.append(compression)
    return map_, CompressReport(tuple(done))


def _learnt(map_: Map, kind: str, config: CompressConfig) -> DescriptorProjection:
    blocks = [descriptor_block(map_, row) for row in _sets_of(map_, kind).tolist()]
    if len({block.shape[1] for block in blocks}) != 1:
        raise MapError(f"descriptors of kind {kind} have several lengths")
    everything = np.concatenate(blocks)
    rng = np.random.default_rng(_SEED)
    count = min(config.max_samples, len(everything))
    sample = as_numbers(everything[rng.choice(len(everything), count, replace=False)])
    if not sample.shape[1] > config.dimensions < count:
        found = f"{count} descriptors of kind {kind} with {sample.shape[1]} numbers"
        raise MapError(f"{found} cannot be compressed to {config.dimensions} numbers")
    return principal_components(sample, kind, config.dimensions)


def _compressed(map_: Map, projection: DescriptorProjection) -> tuple[Map, Compression]:
    sets = map_.feature_sets
    rows = _sets_of(map_, projection.kind)
    num_inputs, num_outputs = projection.matrix.shape
    rows = rows[sets.width[rows] == num_inputs]
    width, descriptors = sets.width.copy(), sets.descriptors.copy()
    width[rows] = num_outputs
    count = 0
    for row in rows.tolist():
        block = descriptor_block(map_, row)
        descriptors[row] = projection(block).astype("<f4").tobytes()
        count += len(block)
    changed = replace(sets, width=width, descriptors=descriptors)
    return replace(map_, feature_sets=changed), Compression(
        kind=projection.kind,
        num_descriptors=count,
        num_bytes_before=4 * num_inputs * count,
        num_bytes=4 * num_outputs * count,
    )


def principal_components(sample: Float32Array, kind: str, dimensions: int) -> DescriptorProjection:
    """Return the projection of descriptors (N, D) that keeps most of their variance."""
    mean = sample.mean(axis=0)
    directions = np.linalg.eigh(_covariance(sample - mean))[1]
    matrix = directions[:, ::-1][:, :dimensions].astype(np.float32)
    return DescriptorProjection(kind, "compression", mean, matrix)


def train_projection(map_: Map, config: TrainProjectionConfig) -> tuple[Map, TrainReport]:
    """Return the map with projections that bring descriptors of one point together.

    Points are known by their landmarks, and where there are none by their tracks.

    Raises:
        MapError: If there are no such descriptors, or too few points of a kind are seen twice.
    """
    done = []
    for kind in _kinds(map_, config.kind, "uint8"):
        same, different = _pairs(map_, kind, config.max_pairs)
        projection = separating(same, different, kind, config.dimensions)
        map_ = with_projection(map_, projection)
        done.append(
            Training(
                kind=kind, num_pairs=len(same), separation=_separation(same, different, config)
            )
        )
    return map_, TrainReport(tuple(done))


def _separation(
    same: Float32Array, different: Float32Array, config: TrainProjectionConfig
) -> float:
    """Return how much better every other pair is told apart by what the pairs between them teach."""
    half = separating(same[::2], different[::2], "", config.dimensions)
    apart, together = (((d[1::2] @ half.matrix) ** 2).sum(1).mean() for d in (different, same))
    return float(apart / together)


def separating(
    same: Float32Array, different: Float32Array, kind: str, dimensions: int
) -> DescriptorProjection:
    """Return the projection in which differences of two points are longest beside those of one point.

    Along each direction, differences of one point have variance 1. The two halves of the result, which
    a multi-index quantises apart, tell about as much as each other.

    Args:
        same: Differences (N, D) of descriptors of one point.
        different: Differences (N, D) of descriptors of two points.
        kind: Of the features.
        dimensions: Of the result.
    """
    within = _covariance(same)
    within += np.eye(len(within)) * _RIDGE * np.trace(within) / len(within)
    variances, directions = np.linalg.eigh(within)
    whitening = directions / np.sqrt(variances)
    between = whitening.T @ _covariance(different) @ whitening
    best = np.linalg.eigh(between)[1][:, ::-1][:, :dimensions]
    order = np.r_[0 : best.shape[1] : 2, 1 : best.shape[1] : 2]
    matrix = (whitening @ best[:, order]).astype(np.float32)
    return DescriptorProjection(kind, "index", np.zeros(len(matrix), np.float32), matrix)


def _pairs(map_: Map, kind: str, max_pairs: int) -> tuple[Float32Array, Float32Array]:
    """Return differences (N, D) of descriptors of one point, and about as many of two."""
    rows, point = _points(map_, kind)
    rng = np.random.default_rng(_SEED)
    first = np.flatnonzero(point[1:] == point[:-1])
    if len(first) < _MIN_PAIRS:
        raise MapError(
            f"{len(first)} pairs of keypoints of kind {kind} are of one point, expected at least "
            f"{_MIN_PAIRS}; track them first"
        )
    first = rng.permutation(first)[:max_pairs]
    a, b = rng.integers(0, len(rows), (2, len(first)))
    is_apart = point[a] != point[b]
    return (
        _differences(map_, rows[first], rows[first + 1]),
        _differences(map_, rows[a[is_apart]], rows[b[is_apart]]),
    )


def _points(map_: Map, kind: str) -> tuple[IntArray, IntArray]:
    """Return the observations of a kind that are of a known point, and its number; equal ones side by side."""
    seen = map_.observations
    is_described = (seen.kind == kind) & (seen.feature_set >= 0)
    has_landmarks = bool((is_described & (seen.landmark >= 0)).any())
    numbers = seen.landmark if has_landmarks else seen.track
    missions = map_.vertices.mission[seen.vertex]
    if has_landmarks:  # of several missions
        missions = np.zeros_like(missions)
    rows = np.flatnonzero(is_described & (numbers >= 0))
    names = np.stack([missions[rows], numbers[rows]], axis=1)
    point: IntArray = np.unique(names, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(point, kind="stable")
    return rows[order], point[order]


def _differences(map_: Map, a: IntArray, b: IntArray) -> Float32Array:
    first, second = (as_numbers(descriptors_of(map_, rows)) for rows in (a, b))
    return first - second


def _kinds(map_: Map, kind: str, dtype: str) -> list[str]:
    """Return the kind that is asked for, or all with descriptors of a type."""
    sets = map_.feature_sets
    known = sorted(set(sets.kind[(sets.width > 0) & (sets.dtype == dtype)].tolist()))
    if kind and kind not in known:
        raise MapError(f"no descriptors of {dtype} of kind {kind!r} in the map; there are {known}")
    return [kind] if kind else known


def _sets_of(map_: Map, kind: str) -> IntArray:
    return np.flatnonzero((map_.feature_sets.kind == kind) & (map_.feature_sets.width > 0))


def _covariance(differences: Float32Array) -> FloatArray:
    numbers = differences.astype(np.float64)
    covariance: FloatArray = numbers.T @ numbers / max(len(numbers), 1)
    return covariance
