"""Tracks of keypoints whose points are in a frame that stands still: who looks alike and lies at the same place.

Sources: Lindenberger et al., LightGlue, ICCV 2023, where a network matches; Lowe, IJCV 2004, where descriptors do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat

from mapstream.operators.networks.matchers import Matcher, make_matcher
from mapstream.operators.tracking.descriptor_matching import (
    MatchRules,
    differences,
    matched,
    one_to_one,
)
from mapstream.operators.tracking.matched_tracks import MatchedTracks, MatchedTracksConfig
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.messages.vision import ImageFeatures

_NO_MATCHES = np.empty((0, 2), np.int64)


class NearTracksConfig(MatchRules):
    """When a keypoint is of the point of a track."""

    min_similarity: float = Field(default=0.7, ge=0, le=1)
    """Share of equal bits, or cosine, of a match; where a point is tells more than what it looks like."""
    min_similarity_again: float = Field(default=0.75, ge=0, le=1)
    """The same, of a keypoint whose best candidate matched another one better."""
    max_ratio: float = Field(default=0.9, gt=0, le=1)
    """Difference to the best candidate, as a share of that to the second best (Lowe)."""
    max_distance_m: PositiveFloat = 0.07
    """How far from the mean of its track's points a keypoint may lie, beyond its own uncertainty."""
    max_missed: NonNegativeInt = 2
    """So many scans in a row may miss a keypoint before its track ends."""
    matcher: str = ""
    """A network that says what looks alike, as in `network_tracker`: lighterglue for lidar_xfeat, or an ONNX file."""
    min_score: float = Field(default=0.1, ge=0, le=1)
    """Matches that the network is less sure of do not count."""


class Alike:
    """Says which keypoints look alike: a network, or descriptors."""

    def __init__(self, config: NearTracksConfig) -> None:
        self._config = config
        self._network: Matcher | None = None

    def of_all(self, before: ImageFeatures, now: ImageFeatures) -> IntArray:
        """Return which rows (K, 2) of all are alike."""
        if self._config.matcher:
            return self._matched(before, now)
        return matched(before.descriptors, now.descriptors, self._config)

    def of_pairs(self, before: ImageFeatures, now: ImageFeatures, pairs: IntArray) -> IntArray:
        """Return which of some pairs of rows (C, 2) are alike, (K, 2)."""
        if self._config.matcher:
            found, width = self._matched(before, now), len(now)
            return found[np.isin(found @ [width, 1], pairs @ [width, 1])]
        difference = differences(before.descriptors, now.descriptors, pairs)
        return one_to_one(pairs, difference, self._config, before.descriptors)

    def _matched(self, before: ImageFeatures, now: ImageFeatures) -> IntArray:
        if self._network is None:
            self._network = make_matcher(self._config.matcher, self._config.min_score)
        return self._network.match(before, now)


class NearTracks(MatchedTracks):
    """Tracks of keypoints whose points are in a frame that stands still."""

    def __init__(self, config: NearTracksConfig, alike: Alike) -> None:
        super().__init__(MatchedTracksConfig(max_missed=config.max_missed))
        self._config, self._alike = config, alike
        self._places: dict[int, _Place] = {}  # by track

    def candidates(
        self,
        before: ImageFeatures,
        now: ImageFeatures,
        turn: FloatArray | None,  # noqa: ARG002  # the points are where they were
    ) -> IntArray:
        """Return the rows (K, 2) of keypoints before and now that look the same and lie at the same place."""
        from scipy.spatial import cKDTree  # noqa: PLC0415  # heavy, and most runs have no LiDAR images

        if not (len(before) and len(now)) or before.track_ids is None or now.points_m is None:
            return _NO_MATCHES
        places = np.array([self._places[track].mean_m for track in before.track_ids.tolist()])
        reach_m = self._config.max_distance_m + np.zeros(len(now))
        if now.point_sigmas_m is not None:
            reach_m += now.point_sigmas_m
        near = cKDTree(places).sparse_distance_matrix(
            cKDTree(now.points_m), float(reach_m.max()), output_type="ndarray"
        )
        near = near[near["v"] <= reach_m[near["j"]]]
        pairs = np.stack([near["i"], near["j"]], axis=1).astype(np.int64)
        return self._alike.of_pairs(before, now, pairs)

    def follow(self, features: ImageFeatures) -> ImageFeatures:
        """Return the keypoints of the next scan with their track ids."""
        tracked = self.track(features)
        open_tracks = {
            track: place._replace(missed=place.missed + 1)
            for track, place in self._places.items()
            if place.missed <= self._config.max_missed
        }
        points = np.asarray(features.points_m, np.float64)
        for track, point in zip(np.asarray(tracked.track_ids).tolist(), points, strict=True):
            mean_m, seen, _ = open_tracks.get(track, _Place(point, 0, 0))
            open_tracks[track] = _Place(mean_m + (point - mean_m) / (seen + 1), seen + 1, 0)
        self._places = open_tracks
        return tracked


class _Place(NamedTuple):
    """Where the point of a track is, by all that saw it: one that wanders is lost rather than followed."""

    mean_m: FloatArray  # (3,)
    seen: int  # so often
    missed: int  # scans in a row
