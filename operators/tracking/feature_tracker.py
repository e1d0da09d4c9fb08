"""Tracks of keypoints that are matched by their descriptors from image to image."""

from __future__ import annotations

import numpy as np
from pydantic import NonNegativeInt

from mapstream.operators.operator import warn
from mapstream.operators.tracking.matched_tracks import MatchedTracks, MatchedTracksConfig
from mapstream.operators.tracking.turning import turned_px
from mapstream.operators.tracking.windows import WindowRules, matched_near
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.messages.vision import ImageFeatures


class FeatureTrackerConfig(WindowRules, MatchedTracksConfig):
    """Options of `feature_tracker`."""

    max_missed: NonNegativeInt = 3
    """So many images in a row may miss a keypoint before its track ends."""


class FeatureTracker(MatchedTracks):
    """Match keypoints by their descriptors from image to image, near where the gyroscope expects them.

    Without an IMU a keypoint is expected where it was. With one, matches must agree with one translation of the
    camera. A keypoint that is missed waits for some images; one without a match begins a track.
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
