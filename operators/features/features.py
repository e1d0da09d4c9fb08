"""Keypoints with descriptors, of a kind that one word of the graph file chooses."""

from __future__ import annotations

from threading import local
from typing import Literal

from mapstream.operators.features.detectors import (
    Detector,
    DetectorKind,
    DetectorOptions,
    make_detector,
)
from mapstream.operators.features.finder import FeatureFinder
from mapstream.operators.features.gray import gray
from mapstream.operators.features.rows import features_in
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures


class FeaturesConfig(DetectorOptions):
    """Options of `features`."""

    kind: DetectorKind = "brisk"
    """`orb`, `brisk` or `freak`: ORB's corners with bits that describe them; `sift`: slower, and sees across scales."""


class OrbConfig(FeaturesConfig):
    """Options of `orb`."""

    kind: Literal["orb"] = "orb"


class Features(FeatureFinder):
    """Detect and describe keypoints: the strongest, spread over the image, none close to another."""

    def __init__(self, config: FeaturesConfig) -> None:
        self._config = config
        self._of_thread = local()  # a detector that workers share is not safe

    def detect(self, frame: CameraFrame) -> ImageFeatures:
        """Find the keypoints of one image, the strongest first."""
        detector: Detector | None = getattr(self._of_thread, "detector", None)
        if detector is None:
            detector = make_detector(self._config.kind, self._config)
            self._of_thread.detector = detector
        found = detector.detect(gray(frame))
        return features_in(
            frame,
            self._config.kind,
            found.px,
            descriptors=found.descriptors,
            scores=found.scores,
            scales=found.scales,
            orientations_rad=found.orientations_rad,
            sigmas_px=found.sigmas_px,
        )


class Orb(Features):
    """Detect and describe corners with ORB: `features` of kind orb."""

    def __init__(self, config: OrbConfig) -> None:
        super().__init__(config)
