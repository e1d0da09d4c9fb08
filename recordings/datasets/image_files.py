"""Files of images as messages: as they are on disk, or, for depth, in millimetres with zeros where nothing was seen."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from mapstream.streams.errors import RecordingError
from mapstream.streams.messages.sensors import EncodedImage

_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".bmp")
_FASTEST = 1  # of PNG's compressions; the recording is compressed once more


def image_files(folder: Path) -> list[Path]:
    """Return the images of a folder in the order of their names."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES)


def image_of(path: Path, stamp_ns: int, frame: str) -> EncodedImage:
    """Read an image as it is, compressed.

    Raises:
        RecordingError: If the file cannot be read.
    """
    kind = path.suffix.lower().removeprefix(".").replace("jpg", "jpeg")
    data = np.frombuffer(_content(path), np.uint8)
    return EncodedImage(stamp_ns=stamp_ns, data=data, format=kind, frame=frame)


def depth_of(
    path: Path, stamp_ns: int, frame: str, *, units_per_m: float, invalid: int = 0
) -> EncodedImage:
    """Read a depth image of 16 bits, and write it anew in millimetres.

    Raises:
        RecordingError: If the file cannot be read, or is no such image.
    """
    import cv2  # noqa: PLC0415  # heavy, and most data sets need no pixels

    pixels = cv2.imdecode(np.frombuffer(_content(path), np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        found = "nothing" if pixels is None else f"{pixels.dtype} {pixels.shape}"
        raise RecordingError(f"{path}: expected depth as 16 bits of one channel, found {found}")
    data = cv2.imencode(
        ".png", _millimetres(pixels, units_per_m, invalid), [cv2.IMWRITE_PNG_COMPRESSION, _FASTEST]
    )[1]
    return EncodedImage(
        stamp_ns=stamp_ns, data=data.astype(np.uint8, copy=False), format="png", frame=frame
    )


def _millimetres(
    pixels: npt.NDArray[np.generic], units_per_m: float, invalid: int
) -> npt.NDArray[np.uint16]:
    depth = np.where(pixels == invalid, 0, pixels)
    if units_per_m == 1000:
        return depth.astype(np.uint16)
    return np.round(depth * (1000 / units_per_m)).astype(np.uint16)


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error
