"""Tracks of keypoints that are matched from image to image, however that is done."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydantic import NonNegativeInt

from mapstream.operators.features.rows import appended, rows_of
from mapstream.operators.operator import Operator, Placement, offload
from mapstream.operators.tracking.rays import rays
from mapstream.operators.tracking.track_ids import TrackNumbers, carried_on
from mapstream.operators.tracking.turning import GyroTurns, turned_px
from mapstream.operators.tracking.two_point import OutlierOptions, agreeing
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.sensors import ImuBatch
from mapstream.streams.messages.vision import ImageFeatures
from mapstream.streams.sync import anchored


@dataclass(frozen=True)
class Inputs:
    """Keypoints with descriptors, of one camera or several, of one kind or several; and the IMU, which predicts."""

    features: Receiver[ImageFeatures]
    imu: Receiver[ImuBatch] | None = None


@dataclass(frozen=True)
class Outputs:
    """The same messages, with track ids."""

    features: Sender[ImageFeatures]


_NONE = np.empty(0, np.int64)
_NO_MATCHES = np.empty((0, 2), np.int64)


class MatchedTracksConfig(OutlierOptions):
    """How keypoints that match become tracks."""

    max_missed: NonNegativeInt = 1
    """So many images in a row may miss a keypoint before its track ends."""


class MatchedTracks(Operator[Inputs, Outputs]):
    """Match keypoints from image to image; a keypoint without a match begins a track."""

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: MatchedTracksConfig) -> None:
        self._options = config
        self._known: dict[tuple[str, str], _Known] = {}  # by camera and kind
        self._numbers: dict[tuple[str, str], TrackNumbers] = {}

    @abstractmethod
    def candidates(
        self, before: ImageFeatures, now: ImageFeatures, turn: FloatArray | None
    ) -> IntArray:
        """Return the rows (K, 2) of keypoints before and now that look the same; no row comes twice."""

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        turns = GyroTurns(inputs.imu)
        async for features, batches in anchored(
            inputs.features, turns.samples, interval=turns.interval
        ):
            turn = turns.turn(features, batches)
            await outputs.features.send(await offload(self.track, features, turn))

    def track(self, features: ImageFeatures, turn: FloatArray | None = None) -> ImageFeatures:
        """Return the keypoints of the next image with their track ids.

        Args:
            features: The keypoints.
            turn: R_now_before (3, 3) of their camera since the image before, if it is known.
        """
        key = (features.frame, features.kind)
        numbers = self._numbers.setdefault(key, TrackNumbers(features.frame))
        known = self._known.get(key, _Known(rows_of(features, _NONE), _NONE))
        matches = self.matches(known.features, features, turn) if len(known.missed) else _NO_MATCHES
        track_ids = carried_on(known.track_ids, matches, len(features), numbers)
        tracked = replace(features, track_ids=track_ids)
        waiting = known.waiting(matches[:, 0], self._options.max_missed, turn)
        self._known[key] = _Known(
            appended(tracked, waiting.features),
            np.concatenate([np.zeros(len(tracked), np.int64), waiting.missed]),
        )
        return tracked

    def matches(
        self, before: ImageFeatures, now: ImageFeatures, turn: FloatArray | None
    ) -> IntArray:
        """Return the rows (K, 2) of keypoints before and now that are of one point."""
        found = self.candidates(before, now, turn)
        if turn is None or now.camera is None:
            return found
        start = rays(now.camera, before.keypoints_px[found[:, 0]])
        end = rays(now.camera, now.keypoints_px[found[:, 1]])
        return found[agreeing(start, end, turn, self._options, seed=now.stamp_ns)]


@dataclass(frozen=True, slots=True)
class _Known:
    """Keypoints that the next image may show: those of the newest one, and some that it missed."""

    features: ImageFeatures
    missed: IntArray  # (N,) images in a row that missed each

    @property
    def track_ids(self) -> IntArray:
        ids = self.features.track_ids
        return _NONE if ids is None else ids

    def waiting(self, matched_rows: IntArray, max_missed: int, turn: FloatArray | None) -> _Known:
        """Return what was not matched, where the camera's turn takes it; without what was missed too often."""
        camera = self.features.camera
        is_waiting = self.missed < max_missed
        is_waiting[matched_rows] = False
        features, missed = rows_of(self.features, is_waiting), self.missed[is_waiting] + 1
        px = turned_px(camera, features.keypoints_px, turn)
        if camera is None:
            return _Known(features, missed)
        size_px = [camera.width_px, camera.height_px]
        is_inside = np.flatnonzero(((px >= 0) & (px <= np.array(size_px) - 1)).all(axis=1))
        return _Known(rows_of(replace(features, keypoints_px=px), is_inside), missed[is_inside])
