"""Colour to grey."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from mapstream.operators.images.frame_filter import COLORS, FrameFilter, require_encoding
from mapstream.streams.messages.sensors import CameraFrame

_CODES = {"bgr8": cv2.COLOR_BGR2GRAY, "rgb8": cv2.COLOR_RGB2GRAY}


class Gray(FrameFilter):
    """Make colour images mono8; grey ones of 8 or 16 bits pass as they are."""

    def changed(self, frame: CameraFrame) -> CameraFrame:
        require_encoding(frame, "gray", (*COLORS, "mono8", "mono16"))
        if frame.encoding not in COLORS:
            return frame
        image = np.asarray(cv2.cvtColor(frame.image, _CODES[frame.encoding]), np.uint8)
        return replace(frame, image=image, encoding="mono8")
