"""Tracks of keypoints that a network matches from image to image."""

from __future__ import annotations

import anyio.to_thread
from pydantic import Field

from mapstream.operators.networks.matchers import Matcher, make_matcher
from mapstream.operators.tracking.matched_tracks import (
    Inputs,
    MatchedTracks,
    MatchedTracksConfig,
    Outputs,
)
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.messages.vision import ImageFeatures


class NetworkTrackerConfig(MatchedTracksConfig):
    """Options of `network_tracker`."""

    matcher: str = "lighterglue"
    """An installed network: `lighterglue` for features of kind xfeat; or an ONNX file with LightGlue or SuperGlue."""
    min_score: float = Field(default=0.1, ge=0, le=1)
    """Matches that the network is less sure of do not count."""


class NetworkTracker(MatchedTracks):
    """Match keypoints from image to image with LightGlue, SuperGlue or their like.

    With an IMU, matches must agree with one translation of the camera. A keypoint without a match begins a track.
    The default network comes with `mapstream models install lighterglue`.
    """

    def __init__(self, config: NetworkTrackerConfig) -> None:
        super().__init__(config)
        self._config = config
        self._matcher: Matcher | None = None

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        self._matcher = await anyio.to_thread.run_sync(self._open)
        await super().run(inputs, outputs)

    def candidates(
        self,
        before: ImageFeatures,
        now: ImageFeatures,
        turn: FloatArray | None,  # noqa: ARG002  # the network needs no prediction
    ) -> IntArray:
        """Return the rows (K, 2) of keypoints before and now that the network matches."""
        if self._matcher is None:
            self._matcher = self._open()
        return self._matcher.match(before, now)

    def _open(self) -> Matcher:
        return make_matcher(self._config.matcher, self._config.min_score)
