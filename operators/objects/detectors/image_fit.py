"""Images in the size that a network takes, and places in the network's pixels as places in the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.operators.features.gray import gray
from mapstream.streams.arrays import Float32Array
from mapstream.streams.messages.sensors import CameraFrame

FitMode = Literal["corner", "middle", "stretch"]
"""Where the image lies in the network's: at the corner or in the middle, in its proportions; or it fills it."""


@dataclass(frozen=True, slots=True)
class ImageFit:
    """How an image lies in the network's; both are counted from their corners here."""

    size_px: tuple[int, int]  # of the image, width and height
    network_px: tuple[int, int]  # of the network's
    inner_px: tuple[int, int]  # of the same in the network's image
    offset_px: tuple[int, int]  # of its corner there

    @classmethod
    def of(cls, size_px: tuple[int, int], network_px: tuple[int, int], mode: FitMode) -> ImageFit:
        """Fit an image of a width and a height into one of another."""
        if mode == "stretch":
            return cls(size_px, network_px, network_px, (0, 0))
        scale = min(network / own for network, own in zip(network_px, size_px, strict=True))
        inner = tuple(max(1, round(own * scale)) for own in size_px)
        spare = [network - used for network, used in zip(network_px, inner, strict=True)]
        offset = (spare[0] // 2, spare[1] // 2) if mode == "middle" else (0, 0)
        return cls(size_px, network_px, (inner[0], inner[1]), offset)

    @property
    def scale(self) -> npt.NDArray[np.float64]:
        """The network's pixels per pixel of the image, along x and y."""
        return np.array(self.inner_px) / self.size_px

    def boxes(self, corners_px: npt.NDArray[np.floating]) -> Float32Array:
        """Return boxes (N, 4) x_min, y_min, x_max, y_max of the network's image as boxes within the image."""
        corners = (corners_px.reshape(-1, 2, 2) - self.offset_px) / self.scale
        inside = np.clip(corners, 0.0, self.size_px) - 0.5
        return inside.reshape(-1, 4).astype(np.float32)

    def planes(self, frame: CameraFrame, out: Float32Array, *, is_rgb: bool, pad: float) -> None:
        """Write an image into a network's input (3, H, W), values as they are, and others around it."""
        image = frame.image if frame.encoding in ("bgr8", "rgb8") else gray(frame)
        small = image
        if self.inner_px != self.size_px:
            small = np.asarray(cv2.resize(image, self.inner_px, interpolation=cv2.INTER_LINEAR))
        channels: Sequence[npt.NDArray[np.generic]] = (
            cv2.split(small) if small.ndim == 3 else (small, small, small)
        )
        if is_rgb != (frame.encoding == "rgb8"):
            channels = channels[::-1]
        (left, top), (width, height) = self.offset_px, self.inner_px
        rows, columns = slice(top, top + height), slice(left, left + width)
        out[:, :top] = out[:, rows.stop :] = pad
        out[:, rows, :left] = out[:, rows, columns.stop :] = pad
        for plane, channel in zip(out, channels, strict=True):
            plane[rows, columns] = channel
