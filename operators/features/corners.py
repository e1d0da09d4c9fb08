"""Corners for tracking: where an image varies in two directions (Shi and Tomasi, Good Features to Track, CVPR 1994)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from mapstream.operators.features.gray import GrayImage
from mapstream.streams.arrays import Float32Array


def corners(
    image: GrayImage, min_quality: float, min_distance_px: float
) -> tuple[Float32Array, Float32Array]:
    """Return corners (N, 2) and their strength (N,), the strongest first.

    They are looked for at half the resolution, which costs a quarter. A tracker does not mind where exactly
    its patch lies, as long as there is something in it.

    Args:
        image: Shape (H, W).
        min_quality: Least strength, as a share of the strongest corner's.
        min_distance_px: Between two corners.
    """
    height, width = image.shape
    half_size = (max(1, width // 2), max(1, height // 2))
    half = cv2.resize(image, half_size, interpolation=cv2.INTER_AREA)
    found: Any
    found, strength = cv2.goodFeaturesToTrackWithQuality(
        half, 0, min_quality, min_distance_px / 2, np.full_like(half, 255)
    )
    if found is None:  # in spite of its annotation
        return np.empty((0, 2), np.float32), np.empty(0, np.float32)
    scale = np.array([width / half_size[0], height / half_size[1]])
    px = (found.reshape(-1, 2) + 0.5) * scale - 0.5
    return px.astype(np.float32), strength.reshape(-1).astype(np.float32)
