"""Follow points from image to image, and into the right image of a pair."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.features.corners import corners
from mapstream.operators.features.gray import GrayImage, gray
from mapstream.operators.features.rows import features_in, rows_of
from mapstream.operators.operator import warn
from mapstream.operators.tracking.live_tracks import LiveTracks
from mapstream.operators.tracking.optical_flow import FlowOptions, follow
from mapstream.operators.tracking.rays import rays
from mapstream.operators.tracking.stereo import StereoOptions, StereoPair
from mapstream.operators.tracking.track_ids import TrackNumbers
from mapstream.operators.tracking.turning import turned_px
from mapstream.operators.tracking.two_point import OutlierOptions, agreeing
from mapstream.operators.tracking.upkeep import TrackLimits, admitted, survivors
from mapstream.streams.arrays import FloatArray
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures

_NO_PX = np.empty((0, 2), np.float32)


class KltConfig(StereoOptions, OutlierOptions, FlowOptions, TrackLimits):
    """Options of `klt`."""

    max_tracks: int = Field(default=250, gt=0)
    """So many are followed at a time."""
    min_distance_px: PositiveFloat = 15.0
    """No track begins closer to another."""
    border_px: float = Field(default=16.0, ge=0)
    """No track begins closer to the edge of the image."""
    min_corner_quality: float = Field(default=0.005, gt=0, lt=1)
    """Least strength of a corner, as a share of the strongest one's; detections that come in are not asked for it."""
    sigma_px: PositiveFloat = 0.8
    """Uncertainty of a tracked place, for those who use the tracks."""


class KltTracker:
    """The tracks of one camera, or of a stereo pair.

    Points are followed from each image to the next one, there and back; where the turn is known, from where it
    takes them, and then they must agree with one translation. New ones begin where there is room.
    """

    def __init__(self, config: KltConfig, *, finds_corners: bool = True) -> None:
        """Make a tracker of corners, or one that is given all keypoints."""
        self._config = config
        self._finds_corners = finds_corners
        self._numbers: TrackNumbers | None = None
        self._kind = "klt"
        self._image: GrayImage | None = None  # the newest one
        self._live: LiveTracks | None = None

    def track(
        self,
        frame: CameraFrame,
        turn: FloatArray | None = None,
        detections: ImageFeatures | None = None,
    ) -> ImageFeatures:
        """Return the tracks in the next image.

        Args:
            frame: The image.
            turn: R_now_before (3, 3) of the camera since the image before, if it is known.
            detections: Keypoints of this image, some of which become tracks.
        """
        image = gray(frame)
        if detections is not None and (self._live is None or len(self._live.features) == 0):
            self._kind = detections.kind
        live = self._followed(frame, image, turn)
        if self._finds_corners and len(live.features) < self._config.max_tracks:
            detections = self._corners(frame, image)
        elif detections is not None:
            reason = live.unlike(detections)
            if reason is None:
                live = live.refreshed_by(detections)
            else:
                warn(reason)
                detections = None
        if detections is not None:
            live = self._joined(live, detections, image)
        self._image, self._live = image, live
        return live.features

    def track_right(self, left: CameraFrame, right: CameraFrame) -> ImageFeatures:
        """Return where the tracks of the newest image are in the right image of its pair, under the same numbers."""
        config, live = self._config, self._live
        if live is None or self._image is None:
            raise ValueError("the left image has to be tracked before the right one")
        image, left_px = gray(right), live.features.keypoints_px
        pair = StereoPair.of(left, right)
        guess_px = left_px if pair is None else pair.at_infinity(left_px)
        is_known = np.isfinite(live.right_shifts_px[:, 0])
        guess_px = np.where(is_known[:, None], left_px + live.right_shifts_px, guess_px)
        px, good = follow(self._image, image, left_px, guess_px, config)
        if pair is None:
            warn(
                f"{left.frame} and {right.frame} are matched without calibration: any match counts"
            )
        else:
            good &= pair.agrees(left_px, px, config.max_epipolar_px)
        shifts_px = np.where(good[:, None], px - left_px, np.float32(np.nan))
        self._live = replace(live, right_shifts_px=shifts_px)
        found = rows_of(live.features, good)
        return features_in(
            right,
            found.kind,
            px[good],
            scores=found.scores,
            sigmas_px=found.sigmas_px,
            track_ids=found.track_ids,
        )

    def _followed(
        self, frame: CameraFrame, image: GrayImage, turn: FloatArray | None
    ) -> LiveTracks:
        """Return the tracks of the image before that are found in this one."""
        config, before, live = self._config, self._image, self._live
        none = features_in(frame, self._kind, _NO_PX)
        if live is None or before is None:
            return LiveTracks.new(none)
        if before.shape != image.shape:
            warn(f"images of {frame.frame} changed their size; all tracks ended")
            return LiveTracks.new(none)
        start_px = live.features.keypoints_px
        px, good = follow(before, image, start_px, turned_px(frame.camera, start_px, turn), config)
        live, start_px, px = live.moved(px, none).kept(good), start_px[good], px[good]
        good = survivors(px, live.ages, config.merge_distance_px)
        if turn is not None and frame.camera is not None:
            start, end = rays(frame.camera, start_px), rays(frame.camera, px)
            good &= agreeing(start, end, turn, config, seed=frame.stamp_ns)
        return live.kept(good)

    def _corners(self, frame: CameraFrame, image: GrayImage) -> ImageFeatures:
        config = self._config
        px, scores = corners(image, config.min_corner_quality, config.min_distance_px)
        if len(px) == 0:
            warn(f"images of {frame.frame} without a corner: too dark, or without texture")
        return features_in(frame, self._kind, px, scores=scores)

    def _joined(self, live: LiveTracks, detections: ImageFeatures, image: GrayImage) -> LiveTracks:
        """Return the tracks and new ones."""
        px = detections.keypoints_px
        scores = np.ones(len(px), np.float32) if detections.scores is None else detections.scores
        height, width = image.shape
        size_px = (width, height)
        new = rows_of(
            detections, admitted(px, scores, live.features.keypoints_px, size_px, self._config)
        )
        if self._numbers is None:
            self._numbers = TrackNumbers(live.features.frame)
        sigmas_px = new.sigmas_px
        if sigmas_px is None:
            sigmas_px = np.full(len(new), self._config.sigma_px, np.float32)
        numbers = self._numbers.take(len(new))
        return live.joined_by(replace(new, track_ids=numbers, sigmas_px=sigmas_px))
