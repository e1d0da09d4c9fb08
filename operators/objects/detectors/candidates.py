"""What a network says it found in an image, before the best of it is chosen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import BoolArray, Float32Array, IntArray
from mapstream.streams.messages.objects import window


class MaskSource(Protocol):
    """Makes masks of some of the candidates; they cost too much to make of all."""

    def mask(self, row: int, box_px: Float32Array, size_px: tuple[int, int]) -> BoolArray:
        """Return the mask of a candidate over the window of its box (4,) in an image of a width and a height."""
        ...


@dataclass(frozen=True, slots=True)
class Candidates:
    """N boxes of an image, in which the middle of the first pixel is (0, 0)."""

    boxes_px: Float32Array  # (N, 4) x_min, y_min, x_max, y_max
    scores: Float32Array  # (N,)
    classes: IntArray  # (N,)
    masks: MaskSource | None = None
    num_broken: int = 0  # with numbers that are not finite, left out

    def masks_of(self, rows: IntArray, size_px: tuple[int, int]) -> tuple[BoolArray, ...]:
        """Return the masks of some, or none at all where the network makes none."""
        if self.masks is None:
            return ()
        return tuple(self.masks.mask(row, self.boxes_px[row], size_px) for row in rows.tolist())


def sampled(
    grid: Float32Array,
    scale: npt.NDArray[np.float64],
    offset: npt.NDArray[np.float64],
    box_px: Float32Array,
    size_px: tuple[int, int],
) -> Float32Array:
    """Return a grid's values at the pixels of a box's window, between its cells by interpolation.

    Args:
        grid: Shape (h, w).
        scale: Cells per pixel of the image, along x and y.
        offset: Where the image's corner is, in cells from the grid's.
        box_px: The box (4,).
        size_px: Width and height of the image.
    """
    rows, columns = window(box_px, *size_px)
    first = (np.array([columns.start, rows.start]) + 0.5) * scale + offset - 0.5
    to_grid = np.array([[scale[0], 0.0, first[0]], [0.0, scale[1], first[1]]])
    size = columns.stop - columns.start, rows.stop - rows.start
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    values = cv2.warpAffine(grid, to_grid, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, np.float32)
