"""Images, as they were taken."""

from __future__ import annotations

import numpy as np
import rerun as rr

from mapstream.graph.views.scene import Drawing, Entry, Scene
from mapstream.graph.views.unknown import view_unknown
from mapstream.streams.errors import MappingError
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage

_DEPTH_METER = {"16UC1": 1000.0, "32FC1": 1.0}  # value of a metre, by encoding
_COLOR_MODEL = {"bgr8": rr.ColorModel.BGR, "rgb8": rr.ColorModel.RGB}
_MEDIA_TYPE = {"jpeg": "image/jpeg", "jpg": "image/jpeg", "png": "image/png"}


def view_camera_frame(frame: CameraFrame, scene: Scene) -> Drawing:
    """Draw the image; a large one goes as JPEG, depth stays exact."""
    image, settings = frame.image, scene.settings
    if frame.encoding in _DEPTH_METER:
        depth = rr.DepthImage(image, meter=_DEPTH_METER[frame.encoding], colormap="turbo")
        return [Entry.of("", depth)]
    if image.dtype == np.uint8 and image.nbytes > settings.jpeg_above_bytes:
        data = _jpeg(frame, settings.jpeg_quality)
        return [Entry.of("", rr.EncodedImage(contents=data, media_type="image/jpeg"))]
    return [
        Entry.of("", rr.Image(image, color_model=_COLOR_MODEL.get(frame.encoding, rr.ColorModel.L)))
    ]


def view_encoded_image(image: EncodedImage, scene: Scene) -> Drawing:
    """Draw the image as it was recorded, if the viewer knows its format."""
    media_types = [m for name, m in _MEDIA_TYPE.items() if name in image.format.lower()]
    if not media_types:
        return view_unknown(image, scene)
    return [Entry.of("", rr.EncodedImage(contents=image.data.tobytes(), media_type=media_types[0]))]


def _jpeg(frame: CameraFrame, quality: int) -> bytes:
    """Return the image as a JPEG file.

    Raises:
        MappingError: If OpenCV cannot compress it.
    """
    import cv2  # noqa: PLC0415  # heavy, and not every run has images

    image = (
        cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR) if frame.encoding == "rgb8" else frame.image
    )
    is_done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not is_done:
        raise MappingError(f"{frame.encoding} image {image.shape} cannot be written as JPEG")
    return bytes(data)
