"""Keypoints with descriptors, of a kind that one word of the graph file chooses."""

from __future__ import annotations

from dataclasses import dataclass
from threading import local
from typing import ClassVar, Literal

import cv2

from mapstream.operators.features.detectors import (
    Detector,
    DetectorKind,
    DetectorOptions,
    make_detector,
)
from mapstream.operators.features.gray import gray, wrong_size
from mapstream.operators.operator import Operator, Placement, pipeline, report_loss, warn
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures


class FeaturesConfig(DetectorOptions):
    """Options of `features`."""

    kind: DetectorKind = "brisk"
    """`orb`, `brisk` or `freak`: ORB's corners with bits that describe them; `sift`: slower, and sees across scales."""


class OrbConfig(FeaturesConfig):
    """Options of `orb`."""

    kind: Literal["orb"] = "orb"


@dataclass(frozen=True)
class Inputs:
    frames: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    features: Sender[ImageFeatures]  # one per image, even without a keypoint


class Features(Operator[Inputs, Outputs]):
    """Detect and describe keypoints: the strongest, spread over the image, none close to another."""

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: FeaturesConfig) -> None:
        self._config = config
        self._of_thread = local()  # a detector that workers share is not safe

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

    def detect(self, frame: CameraFrame) -> ImageFeatures:
        """Find the keypoints of one image, the strongest first."""
        detector: Detector | None = getattr(self._of_thread, "detector", None)
        if detector is None:
            detector = make_detector(self._config.kind, self._config)
            self._of_thread.detector = detector
        found = detector.detect(gray(frame))
        return ImageFeatures(
            stamp_ns=frame.stamp_ns,
            kind=self._config.kind,
            frame=frame.frame,
            keypoints_px=found.px,
            descriptors=found.descriptors,
            scores=found.scores,
            scales=found.scales,
            orientations_rad=found.orientations_rad,
            sigmas_px=found.sigmas_px,
            T_base_sensor=frame.T_base_sensor,
            camera=frame.camera,
            record=frame.record,
        )

    def _looked_at(self, frame: CameraFrame) -> ImageFeatures | _Refused:
        reason = wrong_size(frame)
        return self.detect(frame) if reason is None else _Refused(frame.stamp_ns, reason)


class Orb(Features):
    """Detect and describe corners with ORB: `features` of kind orb."""

    def __init__(self, config: OrbConfig) -> None:
        super().__init__(config)


@dataclass(frozen=True, slots=True)
class _Refused:
    stamp_ns: int
    reason: str
