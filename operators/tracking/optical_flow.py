"""Where patches of one image are in another (Lucas and Kanade 1981; pyramid of Bouguet 2000), checked backwards."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from mapstream.operators.features.gray import GrayImage
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import BoolArray, Float32Array

_NO_CONTRAST, _SAME_GAIN, _SAME_MEAN = 1.0, 0.02, 1.0  # in grey values, and as a share


class FlowOptions(OperatorConfig):
    """How patches are followed."""

    window_px: PositiveInt = Field(default=21, ge=5, le=61)
    """Side of a patch."""
    num_levels: NonNegativeInt = 3
    """Of the pyramid, above the image itself; each doubles the motion that can be followed."""
    num_iterations: PositiveInt = 20
    max_forward_backward_px: PositiveFloat = 1.0
    """So far from its start a patch may come back when it is followed there and back."""
    max_difference: PositiveFloat = 25.0
    """How much a patch may change, on average [grey values]."""


def follow(
    before: GrayImage,
    now: GrayImage,
    px: Float32Array,
    guess_px: Float32Array,
    options: FlowOptions,
) -> tuple[Float32Array, BoolArray]:
    """Return where points (N, 2) of one image are in another, and which of them were found.

    Args:
        before: Where the points are known; shape (H, W).
        now: Where they are looked for; the same size.
        px: The points.
        guess_px: (N, 2) where to begin to look.
        options: Patches and checks.
    """
    if len(px) == 0:
        return px, np.zeros(0, dtype=bool)
    settings: dict[str, Any] = {
        "winSize": (options.window_px, options.window_px),
        "criteria": (
            cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS,
            options.num_iterations,
            0.01,
        ),
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    now = _as_bright(now, before)
    found, is_found, difference = cv2.calcOpticalFlowPyrLK(
        before, now, px, guess_px.copy(), maxLevel=options.num_levels, **settings
    )
    # on the way back the start is close: a small pyramid will do
    back, is_back, _ = cv2.calcOpticalFlowPyrLK(
        now, before, found, px.copy(), maxLevel=min(1, options.num_levels), **settings
    )
    height, width = now.shape
    places = np.asarray(found, np.float32)
    error_px = np.linalg.norm(back - px, axis=1)
    good = is_found.reshape(-1).astype(bool) & is_back.reshape(-1).astype(bool)
    good &= difference.reshape(-1) <= options.max_difference
    good &= error_px <= options.max_forward_backward_px
    good &= ((places >= 0) & (places <= [width - 1, height - 1])).all(axis=1)
    return places, good


def _as_bright(image: GrayImage, pattern: GrayImage) -> GrayImage:
    """Return an image with the mean and the contrast of another one: cameras expose as they please."""
    mean, deviation = (float(value.item()) for value in cv2.meanStdDev(image))
    wanted_mean, wanted = (float(value.item()) for value in cv2.meanStdDev(pattern))
    if min(wanted, deviation) < _NO_CONTRAST:
        return image
    gain = wanted / deviation
    if abs(gain - 1) < _SAME_GAIN and abs(wanted_mean - mean) < _SAME_MEAN:
        return image
    return np.asarray(
        cv2.convertScaleAbs(image, alpha=gain, beta=wanted_mean - gain * mean), np.uint8
    )
