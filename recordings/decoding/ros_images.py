"""ROS images and camera descriptions as messages of ours."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mapstream.recordings.decoding.cursor import CdrCursor
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration, Distortion
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage

# encoding in ROS -> dtype, channels, encoding of ours
_ENCODINGS = {
    "mono8": ("u1", 1, "mono8"),
    "8UC1": ("u1", 1, "mono8"),
    "bgr8": ("u1", 3, "bgr8"),
    "8UC3": ("u1", 3, "bgr8"),
    "rgb8": ("u1", 3, "rgb8"),
    "bgra8": ("u1", 4, "bgr8"),
    "rgba8": ("u1", 4, "rgb8"),
    "mono16": ("u2", 1, "mono16"),
    "16UC1": ("u2", 1, "16UC1"),
    "32FC1": ("f4", 1, "32FC1"),
}
_DISTORTIONS: dict[str, Distortion] = {  # name in ROS and Foxglove -> ours
    "": "none",
    "none": "none",
    "plumb_bob": "radtan",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "rational_polynomial": "rational_polynomial",
}
_COMPRESSED_DEPTH_HEADER = 12  # bytes that image_transport puts before the PNG


def image(cursor: CdrCursor) -> CameraFrame:
    """Read a sensor_msgs/Image."""
    stamp_ns, frame = cursor.header()
    height, width, encoding = cursor.u32(), cursor.u32(), cursor.text()
    is_big_endian, row_bytes, data = cursor.u8(), cursor.u32(), cursor.sequence("<u1")
    cursor.end()
    pixels, encoding = pixels_of(
        data,
        encoding,
        shape=(height, width),
        row_bytes=row_bytes,
        is_big_endian=bool(is_big_endian),
    )
    return CameraFrame(stamp_ns=stamp_ns, image=pixels, encoding=encoding, frame=frame or "camera")


def pixels_of(
    data: npt.NDArray[np.uint8],
    encoding: str,
    *,
    shape: tuple[int, int],
    row_bytes: int,
    is_big_endian: bool = False,
) -> tuple[npt.NDArray[np.generic], str]:
    """Return a view on raw pixels and our name of their encoding; alpha is left out.

    Raises:
        ValueError: If the encoding is not known, or the sizes do not agree.
    """
    if encoding not in _ENCODINGS:
        raise ValueError(f"image encoding {encoding!r}; known: {', '.join(_ENCODINGS)}")
    kind, channels, ours = _ENCODINGS[encoding]
    dtype = np.dtype((">" if is_big_endian else "<") + kind)
    height, width = shape
    least = width * channels * dtype.itemsize
    if row_bytes < least or len(data) < height * row_bytes:
        raise ValueError(
            f"{width} x {height} {encoding} with rows of {row_bytes} bytes does not fit in {len(data)}"
        )
    pixels = np.ndarray(
        (height, width, channels),
        dtype,
        data.data,
        strides=(row_bytes, channels * dtype.itemsize, dtype.itemsize),
    )
    native = pixels.astype(dtype.newbyteorder("=")) if is_big_endian else pixels
    return (native[:, :, 0] if channels == 1 else native[:, :, :3]), ours


def compressed_image(cursor: CdrCursor) -> EncodedImage:
    """Read a sensor_msgs/CompressedImage, compressedDepth included."""
    stamp_ns, frame = cursor.header()
    text, data = cursor.text(), cursor.sequence("<u1")
    cursor.end()
    if "compressedDepth" in text:
        data = data[_COMPRESSED_DEPTH_HEADER:]
    return EncodedImage(stamp_ns=stamp_ns, data=data, format=_format(text), frame=frame or "camera")


def _format(text: str) -> str:
    """Return jpeg, png ... of texts such as `bgr8; jpeg compressed bgr8`."""
    known = ("jpeg", "jpg", "png", "tiff", "webp", "h264", "h265")
    found = next((name for name in known if name in text.lower()), text or "jpeg")
    return "jpeg" if found == "jpg" else found


def camera_info(cursor: CdrCursor) -> CameraCalibration:
    """Read the intrinsics of a sensor_msgs/CameraInfo; binning and region of interest are refused."""
    stamp_ns, frame = cursor.header()
    height, width, name = cursor.u32(), cursor.u32(), cursor.text()
    parameters, K = cursor.sequence("<f8"), cursor.array("<f8", 9)
    cursor.array("<f8", 9 + 12)  # rectification, projection
    if not cursor.is_at_end:  # some writers leave out what they do not have
        binning, region = cursor.array("<u4", 2), cursor.array("<u4", 4)
        cursor.u8()
        cursor.end()
        if (binning > 1).any() or region[:2].any():
            raise ValueError("binning and regions of interest are not supported")
    return calibration_of(
        name, parameters, K, size_px=(width, height), stamp_ns=stamp_ns, frame=frame
    )


def calibration_of(
    name: str,
    parameters: FloatArray,
    K: FloatArray,
    *,
    size_px: tuple[int, int],
    stamp_ns: int,
    frame: str,
) -> CameraCalibration:
    """Return a pinhole camera with a distortion as ROS names it.

    Raises:
        ValueError: If the distortion is not known, or the camera is not calibrated.
    """
    if name not in _DISTORTIONS:
        raise ValueError(f"distortion {name!r}; known: {', '.join(filter(None, _DISTORTIONS))}")
    distortion = _DISTORTIONS[name] if parameters.any() else "none"
    if distortion == "rational_polynomial" and not parameters[5:].any():
        distortion, parameters = "radtan", parameters[:5]
    if not K.any():
        raise ValueError("the camera is not calibrated: all of K is zero")
    return CameraCalibration(
        stamp_ns=stamp_ns,
        frame=frame or "camera",
        width_px=size_px[0],
        height_px=size_px[1],
        focal_px=K[[0, 4]],
        center_px=K[[2, 5]],
        distortion=distortion,
        distortion_parameters=np.empty(0) if distortion == "none" else parameters,
    )
