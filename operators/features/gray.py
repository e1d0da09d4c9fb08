"""Images as detectors and trackers want them: 8 bits of grey."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.streams.messages.sensors import CameraFrame

GrayImage = npt.NDArray[np.uint8]


def gray(frame: CameraFrame) -> GrayImage:
    """Return an image (H, W) of 8 bits; 16 bits and floats are stretched over what the image holds."""
    image: npt.NDArray[Any] = frame.image
    if frame.encoding == "bgr8":
        image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    elif frame.encoding == "rgb8":
        image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    elif image.dtype != np.uint8:
        image = cv2.normalize(np.nan_to_num(image), np.empty(0), 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
    return np.ascontiguousarray(image, np.uint8)
