"""Tracks of keypoints that are matched from image to image, however that is done."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar

from mapstream.operators.operator import Operator, Placement, offload
from mapstream.operators.tracking.rays import rays
from mapstream.operators.tracking.track_ids import TrackNumbers, carried_on
from mapstream.operators.tracking.turning import GyroTurns
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


class MatchedTracks(Operator[Inputs, Outputs]):
    """Match keypoints from image to image; a keypoint without a match begins a track."""

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: OutlierOptions) -> None:
        self._options = config
        self._before: dict[tuple[str, str], ImageFeatures] = {}  # by camera and kind
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
        before = self._before.get(key)
        numbers = self._numbers.setdefault(key, TrackNumbers(features.frame))
        if before is None or before.track_ids is None:
            track_ids = numbers.take(len(features))
        else:
            matches = self.matches(before, features, turn)
            track_ids = carried_on(before.track_ids, matches, len(features), numbers)
        self._before[key] = replace(features, track_ids=track_ids)
        return self._before[key]

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
