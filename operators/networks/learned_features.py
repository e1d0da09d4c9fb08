"""What operators with a network for keypoints have in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import anyio.to_thread
import cv2
import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.features.gray import gray, wrong_size
from mapstream.operators.networks.keypoints import KeypointNetwork
from mapstream.operators.operator import (
    Operator,
    OperatorConfig,
    Placement,
    offload,
    report_loss,
    warn,
)
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures


class LearnedConfig(OperatorConfig):
    """Options of all networks that find keypoints."""

    max_features: PositiveInt = 512
    """So many are kept, the best."""
    image_scale: float = Field(default=1.0, gt=0.1, le=1.0)
    """Of the image in which is searched; the time goes with its square."""
    sigma_px: PositiveFloat = 0.8
    """Uncertainty of a keypoint at scale 1."""


@dataclass(frozen=True)
class Inputs:
    frames: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    features: Sender[ImageFeatures]  # one per image, even without a keypoint


class LearnedFeatures(Operator[Inputs, Outputs]):
    """Find keypoints with a network."""

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: LearnedConfig) -> None:
        self._sigma_px = config.sigma_px / config.image_scale

    def open(self) -> KeypointNetwork:
        """Return the network, ready to run."""
        raise NotImplementedError

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        cv2.setNumThreads(1)  # operators run beside each other
        network = await anyio.to_thread.run_sync(self.open)
        async for frame in inputs.frames:
            reason = wrong_size(frame)
            if reason is not None:
                report_loss(reason)
                outputs.features.advance(frame.stamp_ns)
                continue
            found = await offload(self.detect, network, frame)
            if len(found) == 0:
                warn(f"images of {found.frame} without a keypoint: too dark, or without texture")
            await outputs.features.send(found)

    def detect(self, network: KeypointNetwork, frame: CameraFrame) -> ImageFeatures:
        """Find the keypoints of one image, the best first."""
        found = network.find(gray(frame))
        return ImageFeatures(
            stamp_ns=frame.stamp_ns,
            kind=network.kind,
            frame=frame.frame,
            keypoints_px=found.px,
            descriptors=found.descriptors,
            scores=found.scores,
            sigmas_px=np.full(len(found.px), self._sigma_px, np.float32),
            T_base_sensor=frame.T_base_sensor,
            camera=frame.camera,
            record=frame.record,
        )
