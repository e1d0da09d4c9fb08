"""Tracks of keypoints that are matched by their descriptors from image to image."""

from __future__ import annotations

import numpy as np

from mapstream.operators.operator import warn
from mapstream.operators.tracking.matched_tracks import MatchedTracks
from mapstream.operators.tracking.turning import turned_px
from mapstream.operators.tracking.two_point import OutlierOptions
from mapstream.operators.tracking.windows import WindowRules, matched_near
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.messages.vision import ImageFeatures


class FeatureTrackerConfig(WindowRules, OutlierOptions):
    """Options of `feature_tracker`."""


class FeatureTracker(MatchedTracks):
    """Match keypoints by their descriptors from image to image, near where the gyroscope expects them.

    Without an IMU a keypoint is expected where it was. With one, matches must agree with one translation of the
    camera. A keypoint without a match begins a track.
    """

    def __init__(self, config: FeatureTrackerConfig) -> None:
        super().__init__(config)
        self._config = config

    def candidates(
        self, before: ImageFeatures, now: ImageFeatures, turn: FloatArray | None
    ) -> IntArray:
        """Return the rows (K, 2) of keypoints before and now that look the same; no row comes twice."""
        if before.descriptors.shape[1] != now.descriptors.shape[1] and len(before) and len(now):
            warn(f"descriptors of kind {now.kind} changed their length; all tracks ended")
            return np.empty((0, 2), dtype=np.int64)
        expected_px = turned_px(now.camera, before.keypoints_px, turn)
        return matched_near(before, now, expected_px, self._config)
