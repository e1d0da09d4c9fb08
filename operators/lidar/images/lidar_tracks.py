"""Tracks of keypoints that have 3D points: a match must look alike, and lie where its point was.

Where the robot is comes from an odometry, or without one from the keypoints themselves: from the pose on which most of
those that look alike agree (Fischler and Bolles, CACM 1981; Umeyama, PAMI 1991).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.lidar.images.near_tracks import Alike, NearTracks, NearTracksConfig
from mapstream.operators.operator import Operator, Placement, offload, warn
from mapstream.operators.places.geometry.consensus import ConsensusConfig, find_pose
from mapstream.operators.places.geometry.sightings import Sensor, Sightings, make_sightings
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError, OperatorError
from mapstream.streams.geometry import SE3, se3_exp
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.vision import ImageFeatures
from mapstream.streams.sync import anchored, nearest


class LidarTracksConfig(NearTracksConfig):
    """Options of `lidar_tracks`."""

    max_apart_s: PositiveFloat = 0.001
    """So far the odometry's stamp may be from that of the keypoints."""
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
        self._alike = Alike(config)
        self._tracks = NearTracks(config, self._alike)
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
