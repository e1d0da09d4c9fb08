"""What whole images look like, for finding places again (the role of NetVLAD, Arandjelovic et al., CVPR 2016)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import anyio.to_thread
import cv2
import numpy as np
from pydantic import Field, NonNegativeFloat

from mapstream.operators.features.gray import gray
from mapstream.operators.networks.embeddings import (
    Embedding,
    FileEmbedding,
    MobileNetVlad,
    RgbImage,
)
from mapstream.operators.operator import (
    Operator,
    OperatorConfig,
    OptionalPath,
    Placement,
    offload,
    warn,
)
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import GlobalDescriptor


class GlobalDescriptorsConfig(OperatorConfig):
    """Options of `global_descriptors`."""

    model: OptionalPath = None
    """An ONNX file that makes a vector of an RGB image; without one, MobileNetV2 with VLAD."""
    long_side_px: int = Field(default=320, ge=64)
    """Of the image that the network sees, where the network leaves it open."""
    period_s: NonNegativeFloat = 0.0
    """Images of a camera that come sooner after a described one are passed over."""


@dataclass(frozen=True)
class Inputs:
    frames: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    descriptors: Sender[GlobalDescriptor]


class GlobalDescriptors(Operator[Inputs, Outputs]):
    """Describe images by one vector each; about 20 ms per image.

    The weights of the default network come with `mapstream models install mobilenet_v2`.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: GlobalDescriptorsConfig) -> None:
        self._config = config
        self._next_ns: dict[str, int] = {}  # by camera

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        cv2.setNumThreads(1)  # operators run beside each other
        embedding = await anyio.to_thread.run_sync(self.open)
        period_ns = round(self._config.period_s * 1e9)
        async for frame in inputs.frames:
            outputs.descriptors.advance(frame.stamp_ns)
            if frame.stamp_ns < self._next_ns.get(frame.frame, frame.stamp_ns):
                continue
            self._next_ns[frame.frame] = frame.stamp_ns + period_ns
            image = rgb(frame)
            if image.min() == image.max():
                warn(f"images of {frame.frame} of one colour have no descriptor")
                continue
            await outputs.descriptors.send(await offload(self.describe, embedding, frame, image))

    def open(self) -> Embedding:
        """Return the network, ready to run."""
        config = self._config
        if config.model is None:
            return MobileNetVlad(config.long_side_px)
        return FileEmbedding(config.model, config.long_side_px)

    def describe(
        self, embedding: Embedding, frame: CameraFrame, image: RgbImage
    ) -> GlobalDescriptor:
        """Return the descriptor of one image."""
        model = self._config.model
        return GlobalDescriptor(
            stamp_ns=frame.stamp_ns,
            kind="mobilenet_v2_vlad" if model is None else model.stem,
            frame=frame.frame,
            vector=embedding.vector(image),
        )


def rgb(frame: CameraFrame) -> RgbImage:
    """Return an image (H, W, 3) as networks want it."""
    if frame.encoding == "rgb8":
        return frame.image
    if frame.encoding == "bgr8":
        return frame.image[..., ::-1]
    return np.repeat(gray(frame)[..., None], 3, axis=2)
