"""ORB keypoints (Rublee et al., ORB: an efficient alternative to SIFT or SURF, ICCV 2011)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from pydantic import Field, PositiveInt

from mapstream.operators.operator import Operator, OperatorConfig, pipeline
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures

_DESCRIPTOR_BYTES = 32


class OrbConfig(OperatorConfig):
    max_features: PositiveInt = Field(default=500, description="strongest corners that are kept")
    num_levels: PositiveInt = Field(default=8, description="of the image pyramid")
    scale_factor: float = Field(default=1.2, gt=1.0, description="between two levels")
    fast_threshold: PositiveInt = Field(default=20, description="least contrast of a corner")


@dataclass(frozen=True)
class Inputs:
    frames: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    features: Sender[ImageFeatures]  # one per image, even without a keypoint


class Orb(Operator[Inputs, Outputs]):
    """Detect and describe corners with OpenCV's ORB."""

    placement = "thread"

    def __init__(self, config: OrbConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        await pipeline(self.detect, inputs.frames, outputs.features.send)

    def detect(self, frame: CameraFrame) -> ImageFeatures:
        """Find the keypoints of one image, the strongest first."""
        config = self._config
        orb = cv2.ORB.create(  # made anew: a detector that workers share is not safe
            nfeatures=config.max_features,
            scaleFactor=config.scale_factor,
            nlevels=config.num_levels,
            fastThreshold=config.fast_threshold,
        )
        keypoints, descriptors = orb.detectAndCompute(_gray(frame), None)
        count = len(keypoints)
        scores = np.fromiter((k.response for k in keypoints), np.float32, count)
        order = np.argsort(-scores, kind="stable")[: config.max_features]
        points = np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2)
        angles = np.fromiter((k.angle for k in keypoints), np.float32, count)
        scales = np.fromiter((k.size for k in keypoints), np.float32, count)
        if count == 0:  # OpenCV returns None
            descriptors = np.empty((0, _DESCRIPTOR_BYTES), np.uint8)
        return ImageFeatures(
            stamp_ns=frame.stamp_ns,
            kind="orb",
            frame=frame.frame,
            keypoints_px=points[order],
            descriptors=descriptors[order],
            scores=scores[order],
            scales=scales[order],
            orientations_rad=np.radians(angles[order]),
        )


def _gray(frame: CameraFrame) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Return an image of 8 bits; 16 bits are stretched over what the image holds."""
    image = frame.image
    if frame.encoding == "bgr8":
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
    if frame.encoding == "rgb8":
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    if image.dtype == np.uint8:
        return image
    return np.asarray(
        cv2.normalize(image, np.empty(0), 0, 255, cv2.NORM_MINMAX, cv2.CV_8U), np.uint8
    )
