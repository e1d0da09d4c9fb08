"""Pictures that any machine paints alike."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def picture(
    seed: int, shift_px: tuple[int, int] = (0, 0), size_px: tuple[int, int] = (192, 128)
) -> npt.NDArray[np.uint8]:
    """Return a grey image (H, W) of overlapping rectangles; a shift moves the view right and down."""
    rng = np.random.default_rng(seed)
    width, height = size_px
    x, y = np.meshgrid(np.arange(width) + shift_px[0], np.arange(height) + shift_px[1])
    image = np.full((height, width), 128, np.uint8)
    for _ in range(60):
        left, top = rng.integers(-16, 240), rng.integers(-16, 180)
        wide, high = rng.integers(8, 48, 2)
        inside = (x >= left) & (x < left + wide) & (y >= top) & (y < top + high)
        image[inside] = rng.integers(0, 256)
    return image
