"""What operators that find keypoints in images have in common, whatever finds them."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import cv2

from mapstream.operators.images.calibrated import fitted
from mapstream.operators.operator import Operator, Placement, pipeline, report_loss, warn
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures


@dataclass(frozen=True)
class Inputs:
    frames: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    features: Sender[ImageFeatures]  # one per image, even without a keypoint


class FeatureFinder(Operator[Inputs, Outputs]):
    """Find keypoints in each image that is as large as its calibration says."""

    placement: ClassVar[Placement] = "thread"

    @abstractmethod
    def detect(self, frame: CameraFrame) -> ImageFeatures:
        """Find the keypoints of one image, the strongest first."""

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        cv2.setNumThreads(1)  # operators run beside each other

        async def send(result: ImageFeatures | _Refused) -> None:
            if isinstance(result, _Refused):
                report_loss(result.reason)
                outputs.features.advance(result.stamp_ns)
                return
            if len(result) == 0:
                warn(f"images of {result.frame} without a keypoint: too dark, or without texture")
            await outputs.features.send(result)

        await pipeline(self._looked_at, inputs.frames, send)

    def _looked_at(self, frame: CameraFrame) -> ImageFeatures | _Refused:
        fits = fitted(frame, "drop")
        return _Refused(frame.stamp_ns, fits) if isinstance(fits, str) else self.detect(fits)


@dataclass(frozen=True, slots=True)
class _Refused:
    stamp_ns: int
    reason: str
