"""The operator that follows points through images by Lucas and Kanade's optical flow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import cv2

from mapstream.operators.images.calibrated import fitted
from mapstream.operators.operator import Operator, Placement, offload, report_loss, warn
from mapstream.operators.tracking.klt_tracker import KltConfig, KltTracker
from mapstream.operators.tracking.stereo import fitted_pair
from mapstream.operators.tracking.turning import GyroTurns
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.sensors import CameraFrame, ImuBatch
from mapstream.streams.messages.vision import ImageFeatures
from mapstream.streams.sync import anchored, nearest


@dataclass(frozen=True)
class Inputs:
    """Images; those of the right camera of a pair; the IMU, which predicts; keypoints to follow, instead of corners."""

    frames: Receiver[CameraFrame]
    right_frames: Receiver[CameraFrame] | None = None
    imu: Receiver[ImuBatch] | None = None
    features: Receiver[ImageFeatures] | None = None


@dataclass(frozen=True)
class Outputs:
    """All tracks of each image, and those of them that the right image shows, under the same numbers."""

    features: Sender[ImageFeatures]
    right_features: Sender[ImageFeatures]


class Klt(Operator[Inputs, Outputs]):
    """Follow corners, or keypoints of any kind, by Lucas and Kanade's optical flow.

    A track is followed there and back, and ends where it does not come back to its start. With an IMU it is
    looked for where the gyroscope says, and must agree with one translation of the camera. Of two tracks that meet the
    older goes on; new ones begin away from others and from the border.
    With `features` connected, tracks are of their kind and keep their descriptors, renewed where a detection is
    within 2 px.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: KltConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        cv2.setNumThreads(1)  # operators run beside each other
        tracker = KltTracker(self._config, finds_corners=inputs.features is None)
        turns = GyroTurns(inputs.imu)
        apart_ns = round(self._config.max_pair_apart_s * 1e9)
        async for frame, batches, right, detections in anchored(
            inputs.frames,
            turns.samples,
            nearest(inputs.right_frames, apart_ns, optional=True),
            nearest(inputs.features, 0, optional=True),
            interval=turns.interval,
        ):
            turn = turns.turn(frame, batches)
            fits = fitted(frame, "drop")
            if isinstance(fits, str):
                report_loss(fits)
                outputs.features.advance(frame.stamp_ns)
                outputs.right_features.advance(frame.stamp_ns)
                continue
            await outputs.features.send(await offload(tracker.track, frame, turn, detections))
            if inputs.right_frames is None:
                continue
            if right is None:
                warn(f"images of {frame.frame} without one of the right camera")
            elif isinstance(fits := fitted_pair(frame, right), str):
                report_loss(fits)
            else:
                await outputs.right_features.send(await offload(tracker.track_right, frame, right))
                continue
            outputs.right_features.advance(frame.stamp_ns)
