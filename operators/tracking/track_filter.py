"""Tracks of others, without those that no motion of the camera explains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mapstream.operators.features.rows import rows_of
from mapstream.operators.operator import Operator, Placement, offload
from mapstream.operators.tracking.rays import rays
from mapstream.operators.tracking.turning import GyroTurns
from mapstream.operators.tracking.two_point import OutlierOptions, agreeing
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.sensors import ImuBatch
from mapstream.streams.messages.vision import NO_TRACK, ImageFeatures
from mapstream.streams.sync import anchored


class TrackFilterConfig(OutlierOptions):
    """Options of `track_filter`."""


@dataclass(frozen=True)
class Inputs:
    """Keypoints with track ids, of any kinds and cameras; the IMU, which tells how the cameras turned."""

    features: Receiver[ImageFeatures]
    imu: Receiver[ImuBatch]


@dataclass(frozen=True)
class Outputs:
    """The same messages, without the keypoints of tracks that were dropped."""

    features: Sender[ImageFeatures]


class TrackFilter(Operator[Inputs, Outputs]):
    """Drop tracks that disagree with the translation of the camera; keep the ids of the others as they are.

    Between two images of a camera the gyroscope gives the rotation, and most tracks agree with one translation.
    A track that does not is dropped for good. Where the rotation is not known nothing is dropped.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: TrackFilterConfig) -> None:
        self._config = config
        self._before: dict[tuple[str, str], ImageFeatures] = {}  # by camera and kind, as they came
        self._dropped: dict[tuple[str, str], IntArray] = {}

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        turns = GyroTurns(inputs.imu)
        async for features, batches in anchored(
            inputs.features, turns.samples, interval=turns.interval
        ):
            turn = turns.turn(features, batches)
            await outputs.features.send(await offload(self.filtered, features, turn))

    def filtered(self, features: ImageFeatures, turn: FloatArray | None) -> ImageFeatures:
        """Return the keypoints that agree, or have no track.

        Args:
            features: The keypoints of the next image.
            turn: R_now_before (3, 3) of their camera since the image before, if it is known.
        """
        if features.track_ids is None:
            return features
        key = (features.frame, features.kind)
        before = self._before.get(key)
        self._before[key] = features
        dropped = self._dropped.get(key, np.empty(0, np.int64))
        dropped = np.intersect1d(dropped, features.track_ids)  # the others have ended
        if before is not None and turn is not None:
            dropped = np.union1d(dropped, self._outliers(before, features, turn, dropped))
        self._dropped[key] = dropped
        return rows_of(features, ~np.isin(features.track_ids, dropped))

    def _outliers(
        self, before: ImageFeatures, now: ImageFeatures, turn: FloatArray, dropped: IntArray
    ) -> IntArray:
        """Return the ids of tracks that do not agree, of those that were not dropped before."""
        camera = now.camera
        if camera is None or before.track_ids is None or now.track_ids is None:
            return dropped
        ids, a, b = np.intersect1d(before.track_ids, now.track_ids, return_indices=True)
        wanted = ~np.isin(ids, [NO_TRACK, *dropped])
        start = rays(camera, before.keypoints_px[a[wanted]])
        end = rays(camera, now.keypoints_px[b[wanted]])
        agree = agreeing(start, end, turn, self._config, seed=now.stamp_ns)
        outliers: IntArray = ids[wanted][~agree]
        return outliers
