"""Tracks of keypoints that have 3D points: a match must look alike, and lie where its point was.

Where the robot is comes from an odometry, or without one from the keypoints themselves: from the pose on which most of
those that look alike agree (Fischler and Bolles, CACM 1981; Umeyama, PAMI 1991).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat

from mapstream.operators.networks.matchers import Matcher, make_matcher
from mapstream.operators.operator import Operator, Placement, offload, warn
from mapstream.operators.places.geometry.consensus import ConsensusConfig, find_pose
from mapstream.operators.places.geometry.sightings import Sensor, Sightings, make_sightings
from mapstream.operators.tracking.descriptor_matching import (
    MatchRules,
    differences,
    matched,
    one_to_one,
)
from mapstream.operators.tracking.matched_tracks import MatchedTracks, MatchedTracksConfig
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError, OperatorError
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.vision import ImageFeatures
from mapstream.streams.sync import anchored, nearest

_NO_MATCHES = np.empty((0, 2), np.int64)


class LidarTracksConfig(MatchRules):
    """Options of `lidar_tracks`."""

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
    max_apart_s: PositiveFloat = 0.001
    """So far the odometry's stamp may be from that of the keypoints."""
    matcher: str = ""
    """A network that says what looks alike, as in `network_tracker`: lighterglue for lidar_xfeat, or an ONNX file."""
    min_score: float = Field(default=0.1, ge=0, le=1)
    """Matches that the network is less sure of do not count."""
    consensus: ConsensusConfig = Field(default_factory=ConsensusConfig)
    """When keypoints agree on a motion, where no odometry tells it."""


@dataclass(frozen=True)
class Inputs:
    """Keypoints with 3D points, of one sensor and kind; and an odometry, whose stamps they have."""

    features: Receiver[ImageFeatures]
    odometry: Receiver[Odometry] | None = None


@dataclass(frozen=True)
class Outputs:
    """The same messages, with track ids."""

    features: Sender[ImageFeatures]


class LidarTracks(Operator[Inputs, Outputs]):
    """Follow keypoints with 3D points from scan to scan, by their descriptors and by where they are.

    Points of a sweep are moved to its end with the motion since the scan before.
    A keypoint that is missed waits for some scans; one without a match begins a track.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: LidarTracksConfig) -> None:
        self._config = config
        self._alike = _Alike(config)
        self._tracks = _NearTracks(config, self._alike)
        self._pose: tuple[int, SE3] | None = None  # T_odom_base and its stamp, of the scan before
        self._step: tuple[int, SE3] | None = None  # since the scan before that, and its duration
        self._known: ImageFeatures | None = None  # of the scan before, in the odom frame

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        if inputs.odometry is None:
            async for features in inputs.features:
                await outputs.features.send(await offload(self.track, features))
            return
        apart_ns = round(self._config.max_apart_s * 1e9)
        joined = anchored(inputs.features, nearest(inputs.odometry, apart_ns, optional=True))
        async for features, odometry in joined:
            if odometry is None:
                warn(f"keypoints of {features.frame} without odometry within {apart_ns / 1e6:g} ms")
            pose = None if odometry is None else odometry.T_odom_base
            await outputs.features.send(await offload(self.track, features, pose))

    def track(self, features: ImageFeatures, T_odom_base: SE3 | None = None) -> ImageFeatures:
        """Return the keypoints of the next scan with their track ids; without a pose, they tell it themselves."""
        if features.points_m is None:
            raise OperatorError(
                f"keypoints of kind {features.kind} have no 3D points; `feature_tracker` follows such"
            )
        if T_odom_base is None:
            T_odom_base = self._agreed(features)
        if self._pose is not None:
            before_ns, T_odom_before = self._pose
            self._step = (features.stamp_ns - before_ns, T_odom_before.inverse() @ T_odom_base)
        self._pose = (features.stamp_ns, T_odom_base)
        in_odom = self._placed(features, T_odom_base)
        tracked = self._tracks.follow(in_odom)
        self._known = in_odom
        return replace(features, track_ids=tracked.track_ids)

    def _placed(self, features: ImageFeatures, T_odom_base: SE3) -> ImageFeatures:
        """Return the keypoints with their points in the odom frame."""
        points = T_odom_base @ self._base_points(features)
        return replace(features, points_m=points.astype(np.float32))

    def _base_points(self, features: ImageFeatures) -> FloatArray:
        """Return the points (N, 3) in the base at the time of the stamp."""
        points: FloatArray = features.T_base_sensor @ np.asarray(features.points_m, np.float64)
        if self._step is None or features.offsets_ns is None or self._step[0] <= 0:
            return points
        step_ns, step = self._step
        T = se3_exp((features.offsets_ns / step_ns)[:, None] * step.log())
        moved: FloatArray = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
        return moved

    def _agreed(self, features: ImageFeatures) -> SE3:
        """Return the pose on which the keypoints agree that look like those of the scan before."""
        known = self._known
        if known is None or self._pose is None:
            return SE3.identity()
        pairs = self._alike.of_all(known, features)
        sightings = self._sightings(known, features, pairs)
        try:
            found = find_pose(sightings, self._config.consensus, features.stamp_ns)
        except EstimationError as error:
            warn(f"scans of {features.frame} whose motion the keypoints do not tell: {error}")
            return self._pose[1]
        return found.pose.T_map_base

    def _sightings(
        self, known: ImageFeatures, features: ImageFeatures, pairs: IntArray
    ) -> Sightings:
        """Return which points known before the keypoints may be of."""
        before, now = pairs.T
        sigmas = features.point_sigmas_m
        return make_sightings(
            (Sensor(T_base_sensor=SE3.identity()),),
            sensor=np.zeros(len(pairs), np.int64),
            points_map=np.asarray(known.points_m, np.float64)[before],
            keypoints_px=features.keypoints_px[now].astype(np.float64),
            points_sensor=self._base_points(features)[now],
            sigmas_m=np.full(len(pairs), np.nan)
            if sigmas is None
            else sigmas[now].astype(np.float64),
        )


class _Alike:
    """Says which keypoints look alike: a network, or descriptors."""

    def __init__(self, config: LidarTracksConfig) -> None:
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


class _NearTracks(MatchedTracks):
    """Tracks of keypoints whose points are in a frame that stands still."""

    def __init__(self, config: LidarTracksConfig, alike: _Alike) -> None:
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
