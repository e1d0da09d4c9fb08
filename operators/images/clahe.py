"""Local contrast: CLAHE (Zuiderveld, Contrast Limited Adaptive Histogram Equalization, Graphics Gems IV, 1994)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.images.frame_filter import COLORS, FrameFilter, require_encoding
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.messages.sensors import CameraFrame

_TO_LAB = {"bgr8": cv2.COLOR_BGR2LAB, "rgb8": cv2.COLOR_RGB2LAB}
_FROM_LAB = {"bgr8": cv2.COLOR_LAB2BGR, "rgb8": cv2.COLOR_LAB2RGB}


class ClaheConfig(OperatorConfig):
    """Options of `clahe`."""

    clip_limit: PositiveFloat = Field(
        default=2.0, description="how much contrast may grow, against an even histogram"
    )
    num_tiles: PositiveInt = Field(default=8, description="along each side of the image")


class Clahe(FrameFilter):
    """Spread the grey values of each part of an image; of colours the lightness alone."""

    def __init__(self, config: ClaheConfig) -> None:
        self._config = config

    def changed(self, frame: CameraFrame) -> CameraFrame:
        require_encoding(frame, "clahe", (*COLORS, "mono8", "mono16"))
        if frame.encoding not in COLORS:
            return replace(frame, image=self._spread(frame.image))
        lab = np.asarray(cv2.cvtColor(frame.image, _TO_LAB[frame.encoding]), np.uint8)
        lab[:, :, 0] = self._spread(np.ascontiguousarray(lab[:, :, 0]))
        return replace(frame, image=cv2.cvtColor(lab, _FROM_LAB[frame.encoding]))

    def _spread(self, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        tiles = (self._config.num_tiles, self._config.num_tiles)
        clahe = cv2.createCLAHE(self._config.clip_limit, tiles)  # anew: workers must not share one
        return np.asarray(clahe.apply(image))
