"""Networks that tell what a whole image looks like, each behind one call."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.operators.networks.installed import weights_of
from mapstream.operators.networks.keypoints import in_cells
from mapstream.operators.networks.mobilenet_network import (
    CELL_PX,
    CHANNELS_AT_16,
    feature_map_model,
)
from mapstream.operators.networks.sessions import Session
from mapstream.operators.networks.vlad import load_vocabulary
from mapstream.streams.arrays import Float32Array
from mapstream.streams.errors import ConfigError, OperatorError

RgbImage = npt.NDArray[np.uint8]
_MAP_PX = 16  # between the cells of the map; the sides of the image are multiples of CELL_PX


class Embedding(Protocol):
    """Makes a vector of an image."""

    def vector(self, image: RgbImage) -> Float32Array:
        """Return the vector (D,) of unit length of an image (H, W, 3)."""
        ...


class MobileNetVlad:
    """The cells of MobileNetV2's map at a sixteenth of the image, by the words of a vocabulary.

    Raises:
        ConfigError: If the network is not installed.
    """

    def __init__(self, long_side_px: int) -> None:
        self._vocabulary = load_vocabulary()
        self._cells = MobileNetCells(long_side_px)

    def vector(self, image: RgbImage) -> Float32Array:
        """Return the vector (D,) of unit length of an image (H, W, 3)."""
        return self._vocabulary.vector(self._cells(image))


class MobileNetCells:
    """MobileNetV2's map at a sixteenth of the image.

    Raises:
        ConfigError: If the network is not installed.
    """

    def __init__(self, long_side_px: int) -> None:
        self._long_side_px = long_side_px
        self._session = Session(feature_map_model(weights_of("mobilenet_v2")), "mobilenet_v2")

    def __call__(self, image: RgbImage) -> Float32Array:
        """Return the cells (N, 96) of an image (H, W, 3)."""
        size_px = _sides_px(image, self._long_side_px)
        maps = self._session.run({"image": _planes(image, size_px)})["s16"]
        cells: Float32Array = maps.reshape(CHANNELS_AT_16, -1).T
        return cells

    def grid(self, image: RgbImage) -> tuple[int, int]:
        """Return how many cells an image (H, W, 3) has beside each other, and how many rows of them."""
        width_px, height_px = _sides_px(image, self._long_side_px)
        return width_px // _MAP_PX, height_px // _MAP_PX


class FileEmbedding:
    """A user's file that makes a vector of an image, RGB from 0 to 255.

    Its input is (1, 3, H, W) or (1, H, W, 3), of any type; sizes that it leaves open are multiples of 32.
    Its first output is the vector, (1, D).

    Raises:
        ConfigError: If the file is no such network.
    """

    def __init__(self, file: Path, long_side_px: int) -> None:
        self._session = Session(file, file.name)
        self._long_side_px = long_side_px
        inputs = list(self._session.inputs.items())
        if len(inputs) != 1 or len(inputs[0][1]) != 4 or 3 not in inputs[0][1][1::2]:
            raise ConfigError(
                f"{file}: expected one input, an image (1, 3, H, W) or (1, H, W, 3), found {dict(inputs)}"
            )
        self._input, shape = inputs[0]
        self._is_planar = shape[1] == 3
        self._sides = shape[2:] if self._is_planar else shape[1:3]

    def vector(self, image: RgbImage) -> Float32Array:
        """Return the vector (D,) of unit length of an image (H, W, 3)."""
        width, height = _sides_px(image, self._long_side_px)
        height, width = (
            fixed if isinstance(fixed, int) else open_
            for fixed, open_ in zip(self._sides, (height, width), strict=True)
        )
        planes = _planes(image, (width, height))
        given = planes if self._is_planar else planes.transpose(0, 2, 3, 1)
        found = next(iter(self._session.run({self._input: given}).values())).reshape(-1)
        length = np.linalg.norm(found)
        if not (np.isfinite(length) and length > 0):
            raise OperatorError(f"{self._session.name}: a vector of length {length}")
        vector: Float32Array = (found / length).astype(np.float32)
        return vector


def _sides_px(image: RgbImage, long_side_px: int) -> tuple[int, int]:
    """Return width and height of the image whose longer side is so long, in whole cells."""
    height, width = image.shape[:2]
    scale = long_side_px / max(height, width)
    return in_cells(width * scale, CELL_PX), in_cells(height * scale, CELL_PX)


def _planes(image: RgbImage, size_px: tuple[int, int]) -> npt.NDArray[Any]:
    """Return the image resized to a width and a height, as (1, 3, H, W)."""
    small = cv2.resize(image, size_px, interpolation=cv2.INTER_AREA)
    return small.transpose(2, 0, 1)[None].astype(np.float32)
