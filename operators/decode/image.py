"""Compressed images to pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from pydantic import Field

from mapstream.operators.images.calibrated import WrongSize, fitted, is_black
from mapstream.operators.operator import Operator, OperatorConfig, pipeline, report_loss, warn
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage

_FLAGS = {
    "color": cv2.IMREAD_COLOR,
    "gray": cv2.IMREAD_GRAYSCALE,
    "as_recorded": cv2.IMREAD_UNCHANGED,
    "depth": cv2.IMREAD_UNCHANGED,
}
_SEEN = {  # by dtype and number of dimensions
    ("uint8", 3): "bgr8",
    ("uint8", 2): "mono8",
    ("uint16", 2): "mono16",
    ("float32", 2): "32FC1",
}
_DEPTH = {("uint16", 2): "16UC1", ("float32", 2): "32FC1"}


class ImageDecodeConfig(OperatorConfig):
    mode: Literal["color", "gray", "as_recorded", "depth"] = Field(
        default="as_recorded",
        description="color is bgr8, gray is mono8; 16 bits stay only as recorded (mono16) and as depth"
        " (16UC1, millimetres)",
    )
    on_wrong_size: WrongSize = Field(
        default="drop",
        description="what to do with images that are not of their calibration's size: drop them, or"
        " rescale the calibration",
    )


@dataclass(frozen=True)
class Inputs:
    images: Receiver[EncodedImage]


@dataclass(frozen=True)
class Outputs:
    frames: Sender[CameraFrame]


class ImageDecode(Operator[Inputs, Outputs]):
    """Decode JPEG, PNG and what else OpenCV reads; one that cannot be decoded is dropped and counted.

    OpenCV frees the interpreter while it decodes, so several workers decode at the same time.
    """

    placement = "thread"

    def __init__(self, config: ImageDecodeConfig) -> None:
        self._flag = _FLAGS[config.mode]
        self._encodings = _DEPTH if config.mode == "depth" else _SEEN
        self._on_wrong_size = config.on_wrong_size

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async def send(result: CameraFrame | _Refused) -> None:
            if isinstance(result, CameraFrame):
                if is_black(result):
                    warn(f"images of {result.frame} that are black")
                await outputs.frames.send(result)
            else:
                report_loss(result.reason)
                outputs.frames.advance(result.stamp_ns)

        await pipeline(self.decode, inputs.images, send)

    def decode(self, image: EncodedImage) -> CameraFrame | _Refused:
        """Decode one image."""
        try:
            pixels = cv2.imdecode(image.data, self._flag) if image.data.size else None
        except cv2.error:
            pixels = None
        if pixels is None:
            return _undecodable(image, image.format)
        if pixels.ndim == 3 and pixels.shape[2] == 4:
            pixels = np.ascontiguousarray(pixels[:, :, :3])  # without alpha
        encoding = self._encodings.get((pixels.dtype.name, pixels.ndim))
        if encoding is None:
            return _undecodable(image, f"{image.format} of {pixels.dtype}")
        frame = CameraFrame(
            stamp_ns=image.stamp_ns,
            image=pixels,
            encoding=encoding,
            frame=image.frame,
            T_base_sensor=image.T_base_sensor,
            camera=image.camera,
            record=image.record,
        )
        result = fitted(frame, self._on_wrong_size)
        return _Refused(image.stamp_ns, result) if isinstance(result, str) else result


@dataclass(frozen=True, slots=True)
class _Refused:
    stamp_ns: int
    reason: str


def _undecodable(image: EncodedImage, what: str) -> _Refused:
    return _Refused(image.stamp_ns, f"images of {image.frame} that cannot be decoded ({what})")
