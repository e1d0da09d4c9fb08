"""A map for localisation alone: landmarks, what they look like, and from where they were seen.

It is a map like any other, only small. Source: maplab's localisation summary map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from pydantic import Field, PositiveInt

from mapstream.operators.maps.keyframing import KeyframingConfig, keyframe
from mapstream.operators.maps.sparsify import SparsifyConfig, sparsify
from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.features import descriptor_block
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Edges, Observations, Resources
from mapstream.streams.arrays import BoolArray, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import invert

SOURCE = "summary"
_SIGMA = 1e-3  # [rad, m] of edges that only hold vertices together


class SummaryConfig(OperatorConfig):
    """What a summary keeps."""

    keyframing: KeyframingConfig | None = Field(default_factory=KeyframingConfig)
    """Which vertices; null: all."""
    sparsify: SparsifyConfig | None = Field(default_factory=lambda: SparsifyConfig(share=0.5))
    """Which landmarks; null: all that are not bad."""
    max_observers: PositiveInt = 10
    """Of a landmark; each keeps a descriptor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SummaryReport:
    """What is left."""

    num_vertices: int
    num_landmarks: int
    num_descriptors: int
    bytes_of_descriptors: int


def summarize(map_: Map, config: SummaryConfig | None = None) -> tuple[Map, SummaryReport]:
    """Return a small map in which frames can be localised.

    IMU samples, resources, measurements and keypoints without a landmark go; edges along each mission hold its
    vertices together where they are.

    Raises:
        MapError: If no landmark with a descriptor is left.
    """
    config = config or SummaryConfig()
    map_ = map_.select(landmarks=map_.landmarks.quality != "bad")
    if config.keyframing is not None:
        map_, _ = keyframe(map_, config.keyframing)
    if config.sparsify is not None:
        map_, _ = sparsify(map_, config.sparsify)
    map_ = replace(map_, resources=Resources())
    map_ = map_.select(edges=np.zeros(len(map_.edges), bool), observations=_useful(map_, config))
    map_ = _without_empty(map_)
    if not len(map_.observations):
        raise MapError(
            "nothing of the map can be recognised: no landmark has a descriptor; make landmarks of tracks"
            " first (create-landmarks)"
        )
    map_ = _with_chains(_without_spare_descriptors(map_))
    sets = map_.feature_sets
    return map_, SummaryReport(
        num_vertices=len(map_.vertices),
        num_landmarks=len(map_.landmarks),
        num_descriptors=len(map_.observations),
        bytes_of_descriptors=sum(map(len, sets.descriptors.tolist())),
    )


def _useful(map_: Map, config: SummaryConfig) -> BoolArray:
    """Return which observations stay: of landmarks, with descriptors, spread over their observers."""
    seen = map_.observations
    rows = np.flatnonzero((seen.landmark >= 0) & (seen.feature_set >= 0))
    rows = rows[np.lexsort((map_.vertices.stamp_ns[seen.vertex[rows]], seen.landmark[rows]))]
    _, start, count = np.unique(seen.landmark[rows], return_index=True, return_counts=True)
    place = np.arange(len(rows)) - np.repeat(start, count)
    step = np.repeat(count / np.minimum(count, config.max_observers), count)
    is_first = np.floor(place / step) != np.floor((place - 1) / step)
    keep = np.zeros(len(seen), bool)
    keep[rows[is_first]] = True
    return keep


def _without_empty(map_: Map) -> Map:
    """Return the map without landmarks that nothing sees, and without sets of which nothing is left."""
    seen = map_.observations
    return map_.select(
        landmarks=np.isin(np.arange(len(map_.landmarks)), seen.landmark),
        feature_sets=np.isin(np.arange(len(map_.feature_sets)), seen.feature_set),
    )


def _without_spare_descriptors(map_: Map) -> Map:
    seen, sets = map_.observations, map_.feature_sets
    order = np.argsort(seen.feature_set, kind="stable")
    ends = np.searchsorted(seen.feature_set[order], np.arange(len(sets) + 1))
    unknown = np.full(len(seen), np.nan, np.float32)
    blocks, feature = sets.descriptors.copy(), seen.feature.copy()
    for number, (first, last) in enumerate(pairwise(ends.tolist())):
        rows = order[first:last]
        blocks[number] = descriptor_block(map_, number)[seen.feature[rows]].tobytes()
        feature[rows] = np.arange(len(rows))
    kept: Observations = replace(
        seen,
        feature=feature,
        track=np.full(len(seen), -1),
        score=unknown,
        scale=unknown,
        orientation_rad=unknown,
    )
    return replace(map_, feature_sets=replace(sets, descriptors=blocks), observations=kept)


def _with_chains(map_: Map) -> Map:
    """Return the map with an edge from each vertex to the next one of its mission, as their poses are."""
    missions = range(len(map_.missions))
    rows = [map_.vertices_of(mission) for mission in missions]
    none: list[IntArray] = [np.empty(0, np.int64)]
    a = np.concatenate([*none, *(each[:-1] for each in rows)])
    b = np.concatenate([*none, *(each[1:] for each in rows)])
    poses = map_.vertices.T_mission_base
    chain = Edges(
        kind=np.full(len(a), "odometry", dtype=object),
        vertex_a=a,
        vertex_b=b,
        T_a_b=invert(poses[a]) @ poses[b],
        covariance=np.tile(np.eye(6) * _SIGMA**2, (len(a), 1, 1)),
        source=np.full(len(a), SOURCE, dtype=object),
    )
    return append_edges(map_, chain)
