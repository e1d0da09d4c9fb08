"""Frames whose calibration can be trusted: it is there, and it is of images of this size."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage
from mapstream.streams.messages.vision import ImageFeatures

WrongSize = Literal["drop", "rescale"]
_SAMPLED = 8  # every so many rows and columns are looked at for light
_BLACK = 6 / 255  # of the full range; sensors have a black level of a few counts


def require_camera(seen: CameraFrame | EncodedImage | ImageFeatures) -> CameraCalibration:
    """Return the calibration of an image or of its features, for a stage that cannot work without.

    Raises:
        OperatorError: If there is none; the message says where one may come from.
    """
    if seen.camera is None:
        raise OperatorError(
            f"the camera {seen.frame} has no calibration: no sensor file describes it, and no topic with "
            "a CameraInfo or CameraCalibration is beside its images; give the source of the recording a "
            "`rig`, or name the topic: {topic: /image, calibration: /camera_info}"
        )
    return seen.camera


def fitted(frame: CameraFrame, on_wrong_size: WrongSize) -> CameraFrame | str:
    """Return the frame with a calibration of its own size, or why it has to go.

    Args:
        frame: As it came.
        on_wrong_size: `rescale` for cameras that send their images reduced; a cropped image must not be.
    """
    camera = frame.camera
    height, width = frame.image.shape[:2]
    if camera is None or (camera.width_px, camera.height_px) == (width, height):
        return frame
    if on_wrong_size == "rescale":
        return replace(frame, camera=camera.resized(width, height))
    return (
        f"images of {frame.frame} with {width} x {height} px, where the calibration is of "
        f"{camera.width_px} x {camera.height_px} px (on_wrong_size: rescale, if they are reduced)"
    )


def is_black(frame: CameraFrame) -> bool:
    """Return whether there is no light anywhere in an image; depth is never black."""
    image = frame.image[::_SAMPLED, ::_SAMPLED]
    if frame.encoding not in ("mono8", "bgr8", "rgb8", "mono16") or not image.size:
        return False
    return bool(image.max() <= _BLACK * np.iinfo(image.dtype).max)
