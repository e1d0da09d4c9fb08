"""Images of any recording, compressed or not, to pixels of one kind."""

from __future__ import annotations

from dataclasses import dataclass, replace
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
_WANTED = {"color": "bgr8", "gray": "mono8", "depth": "16UC1"}
_TO_GRAY = {"bgr8": cv2.COLOR_BGR2GRAY, "rgb8": cv2.COLOR_RGB2GRAY}
_TO_COLOR = {"mono8": cv2.COLOR_GRAY2BGR, "rgb8": cv2.COLOR_RGB2BGR}
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
    images: Receiver[EncodedImage | CameraFrame]


@dataclass(frozen=True)
class Outputs:
    frames: Sender[CameraFrame]


class ImageDecode(Operator[Inputs, Outputs]):
    """Decode JPEG, PNG and what else OpenCV reads; one that cannot be decoded is dropped and counted.

    Images that were recorded as pixels are converted alike, so that a graph takes both.
    OpenCV frees the interpreter while it decodes, so several workers decode at the same time.
    """

    placement = "thread"

    def __init__(self, config: ImageDecodeConfig) -> None:
        self._mode = config.mode
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

    def decode(self, image: EncodedImage | CameraFrame) -> CameraFrame | _Refused:
        """Decode one image."""
        if isinstance(image, CameraFrame):
            converted = _converted(image, self._mode)
            return self._fitted(converted) if isinstance(converted, CameraFrame) else converted
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
        decoded = CameraFrame(
            stamp_ns=image.stamp_ns,
            image=pixels,
            encoding=encoding,
            frame=image.frame,
            T_base_sensor=image.T_base_sensor,
            camera=image.camera,
            record=image.record,
        )
        return self._fitted(decoded)

    def _fitted(self, frame: CameraFrame) -> CameraFrame | _Refused:
        result = fitted(frame, self._on_wrong_size)
        return _Refused(frame.stamp_ns, result) if isinstance(result, str) else result


@dataclass(frozen=True, slots=True)
class _Refused:
    stamp_ns: int
    reason: str


def _converted(frame: CameraFrame, mode: str) -> CameraFrame | _Refused:
    """Return pixels as OpenCV would have decoded them from a file; those that fit already are not copied."""
    image, encoding = frame.image, frame.encoding
    if mode == "as_recorded" or encoding == _WANTED.get(mode):
        return frame
    if mode == "depth" and encoding in ("mono16", "32FC1"):
        return replace(frame, encoding="16UC1" if encoding == "mono16" else encoding)
    if mode == "gray" and encoding in _TO_GRAY:
        gray = np.asarray(cv2.cvtColor(image, _TO_GRAY[encoding]), np.uint8)
        return replace(frame, image=gray, encoding="mono8")
    if mode == "gray" and encoding == "mono16":
        return replace(frame, image=(image >> 8).astype(np.uint8), encoding="mono8")
    if mode == "color" and encoding in _TO_COLOR:
        color = np.asarray(cv2.cvtColor(image, _TO_COLOR[encoding]), np.uint8)
        return replace(frame, image=color, encoding="bgr8")
    return _undecodable(frame, f"{encoding} as {mode}")


def _undecodable(image: EncodedImage | CameraFrame, what: str) -> _Refused:
    return _Refused(image.stamp_ns, f"images of {image.frame} that cannot be decoded ({what})")
