"""What detected objects look like, as vectors (the role of NetVLAD on masked instances in maplab 2.0, section IV-D)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import anyio.to_thread
import cv2
import numpy as np
from pydantic import Field

from mapstream.operators.networks.global_descriptors import rgb
from mapstream.operators.objects.looks import BlankedCrops, Looks, MaskedCells
from mapstream.operators.operator import (
    Operator,
    OperatorConfig,
    OptionalPath,
    Placement,
    offload,
    warn,
)
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.sync import merge


class ObjectDescriptorsConfig(OperatorConfig):
    """Options of `object_descriptors`."""

    model: OptionalPath = None
    """An ONNX file that makes a vector of an RGB image; it sees each object alone, with white around it.

    Without one, MobileNetV2 sees the image once, and its map is read where the objects are."""
    long_side_px: int = Field(default=640, ge=64)
    """Of what the network sees, where the network leaves it open; a cell of MobileNetV2's map is 16 px wide."""


@dataclass(frozen=True)
class Inputs:
    """Images and the objects in them, with the same stamps; images without objects are passed over."""

    frames: Receiver[CameraFrame]
    detections: Receiver[ObjectDetections]


@dataclass(frozen=True)
class Outputs:
    """The same objects."""

    detections: Sender[ObjectDetections]


class ObjectDescriptors(Operator[Inputs, Outputs]):
    """Describe objects by one vector each: those of one object are alike, whatever is behind it.

    What has no mask is described by its box.
    The weights of the default network come with `mapstream models install mobilenet_v2`.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: ObjectDescriptorsConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        cv2.setNumThreads(1)  # operators run beside each other
        looks = await anyio.to_thread.run_sync(self.open)
        images: dict[str, CameraFrame] = {}  # the last of each camera
        async for _, message in merge(inputs.frames, inputs.detections):
            outputs.detections.advance(message.stamp_ns)
            if isinstance(message, CameraFrame):
                images[message.frame] = message
                continue
            image = images.get(message.frame)
            if image is None or image.stamp_ns != message.stamp_ns:
                warn(f"objects of {message.frame} without their image have no descriptors")
                await outputs.detections.send(message)
                continue
            await outputs.detections.send(await offload(self.describe, looks, message, image))

    def open(self) -> Looks:
        """Return the network, ready to run."""
        config = self._config
        if config.model is None:
            return MaskedCells(config.long_side_px)
        return BlankedCrops(config.model, config.long_side_px)

    def describe(
        self, looks: Looks, objects: ObjectDetections, frame: CameraFrame
    ) -> ObjectDetections:
        """Return the objects of an image with their vectors.

        Raises:
            OperatorError: If the image has not the size that they were detected in.
        """
        if len(objects) == 0:
            return objects
        height_px, width_px = frame.image.shape[:2]
        if (width_px, height_px) != (objects.width_px, objects.height_px):
            expected = f"{objects.width_px} x {objects.height_px} px, where they were detected"
            found = f"{width_px} x {height_px} px; give object_descriptors the detector's images"
            raise OperatorError(
                f"objects of {objects.frame}: expected images of {expected}, found {found}"
            )
        vectors = looks.vectors(rgb(frame), objects)
        for _ in range(int(np.isnan(vectors[:, 0]).sum())):
            warn(f"objects of {objects.frame} too small for a descriptor")
        if np.isnan(vectors).all():
            return replace(objects, descriptors=None, descriptor_kind="")
        return replace(objects, descriptors=vectors, descriptor_kind=looks.kind)
