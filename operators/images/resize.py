"""Images in another size, and their calibrations with them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.images.frame_filter import DEPTHS, FrameFilter
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.messages.sensors import CameraFrame


class ResizeConfig(OperatorConfig):
    """Options of `resize`."""

    scale: PositiveFloat = Field(default=0.5, description="new size against old")
    width_px: PositiveInt | None = Field(
        default=None, description="the new width, in the place of `scale`; the shape stays"
    )


class Resize(FrameFilter):
    """Resize images; reduced ones are averaged. Depth is picked, for a mean of two depths is nowhere."""

    def __init__(self, config: ResizeConfig) -> None:
        self._config = config

    def changed(self, frame: CameraFrame) -> CameraFrame:
        height, width = frame.image.shape[:2]
        scale = self._config.scale
        if self._config.width_px is not None:
            scale = self._config.width_px / width
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        if frame.encoding in DEPTHS:
            method = cv2.INTER_NEAREST_EXACT
        return replace(
            frame,
            image=np.asarray(cv2.resize(frame.image, size, interpolation=method)),
            camera=frame.camera.resized(*size) if frame.camera else None,
            record=None,  # what lies there has another size
        )
