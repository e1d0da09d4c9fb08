"""What a network that finds keypoints takes and gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.operators.features.gray import GrayImage
from mapstream.streams.arrays import Float32Array


@dataclass(frozen=True, slots=True)
class Keypoints:
    """What a network found, the best first."""

    px: Float32Array  # (N, 2)
    scores: Float32Array  # (N,)
    descriptors: Float32Array  # (N, D) of unit length


class KeypointNetwork(Protocol):
    """Finds and describes keypoints; threads may share it."""

    @property
    def kind(self) -> str:
        """Return what its features are called."""
        ...

    def find(self, image: GrayImage) -> Keypoints:
        """Return the keypoints of an image (H, W)."""
        ...


@dataclass(frozen=True, slots=True)
class FittedImage:
    """An image in the size that a network takes."""

    image: Float32Array  # (H', W') 0 to 255
    scale: npt.NDArray[np.float64]  # (2,) its pixels per pixel of the image itself

    @classmethod
    def of(cls, image: GrayImage, size_px: tuple[int, int]) -> FittedImage:
        """Return an image resized to a width and a height."""
        height, width = image.shape
        small = image
        if size_px != (width, height):
            small = np.asarray(cv2.resize(image, size_px, interpolation=cv2.INTER_AREA), np.uint8)
        return cls(small.astype(np.float32), np.array(size_px) / (width, height))

    def places(self, px: npt.NDArray[np.floating | np.integer]) -> Float32Array:
        """Return where points (N, 2) of this image are in the image itself."""
        return ((px + 0.5) / self.scale - 0.5).astype(np.float32)


def in_cells(length_px: float, cell_px: int) -> int:
    """Return the whole number of cells within a length, in pixels; at least one cell."""
    return max(cell_px, int(length_px) // cell_px * cell_px)
