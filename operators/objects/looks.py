"""What the objects of an image look like, without what is behind them."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from mapstream.operators.networks.embeddings import FileEmbedding, MobileNetCells, RgbImage
from mapstream.operators.networks.vlad import load_vocabulary
from mapstream.streams.arrays import Float32Array
from mapstream.streams.messages.objects import ObjectDetections

_WHITE = 255


class Looks(Protocol):
    """Makes a vector of each object."""

    kind: str  # vectors of different kinds never meet

    def vectors(self, image: RgbImage, objects: ObjectDetections) -> Float32Array:
        """Return the vectors (N, D) of unit length of the objects in an image (H, W, 3); NaN where there is none."""
        ...


class MaskedCells:
    """The cells of MobileNetV2's map that an object covers, by the words of a vocabulary; the map is made once.

    Raises:
        ConfigError: If the network is not installed.
    """

    kind = "mobilenet_v2_masked_vlad"

    def __init__(self, long_side_px: int) -> None:
        self._vocabulary = load_vocabulary()
        self.cells = MobileNetCells(long_side_px)

    def vectors(self, image: RgbImage, objects: ObjectDetections) -> Float32Array:
        """Return the vectors (N, D); NaN for what is smaller than a cell."""
        return self.vectors_of(self.cells(image), self.cells.grid(image), objects)

    def vectors_of(
        self, cells: Float32Array, grid: tuple[int, int], objects: ObjectDetections
    ) -> Float32Array:
        """Return the same, of the cells (columns * rows, 96) of an image, which lie on a grid of columns and rows."""
        weights = covered(objects, grid)
        vectors = self._vocabulary.vectors(cells, weights)
        vectors[(weights.sum(axis=1) < 1) | ~vectors.any(axis=1)] = np.nan
        return vectors


class BlankedCrops:
    """A user's network, run on each object alone, with white where its mask is not.

    Source: Cramariuc et al., maplab 2.0, RA-L 2023, section IV-D, whose network is NetVLAD.

    Raises:
        ConfigError: If the file is no such network.
    """

    def __init__(self, file: Path, long_side_px: int) -> None:
        self.kind = file.stem
        self._embedding = FileEmbedding(file, long_side_px)

    def vectors(self, image: RgbImage, objects: ObjectDetections) -> Float32Array:
        """Return the vectors (N, D); NaN for what covers no pixel."""
        found = {}
        for row in range(len(objects)):
            crop = image[objects.window(row)].copy()
            if objects.masks:
                crop[~objects.masks[row]] = _WHITE
            if not objects.masks or objects.masks[row].any():
                found[row] = self._embedding.vector(crop)
        width = len(next(iter(found.values()))) if found else 1
        vectors = np.full((len(objects), width), np.nan, np.float32)
        for row, vector in found.items():
            vectors[row] = vector
        return vectors


def covered(objects: ObjectDetections, grid: tuple[int, int]) -> Float32Array:
    """Return how much of each cell (N, rows * columns) of a grid over the image each object covers.

    Args:
        objects: Of one image; what has no mask covers its box.
        grid: Columns and rows.
    """
    shares = np.empty((len(objects), grid[0] * grid[1]), np.float32)
    for row in range(len(objects)):
        mask = objects.full_mask(row).astype(np.float32)
        shares[row] = cv2.resize(mask, grid, interpolation=cv2.INTER_AREA).reshape(-1)
    return shares
