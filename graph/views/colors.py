"""Colours, as uint32 0xRRGGBBAA, which Rerun takes without a conversion."""

from __future__ import annotations

from functools import cache
from typing import Literal

import numpy as np
import numpy.typing as npt

ColorArray = npt.NDArray[np.uint32]

# Bright on black, and told apart by people with colour-blindness (after Okabe and Ito, 2008).
MISSIONS = (0xFFB000FF, 0x56B4E9FF, 0x2FD6A3FF, 0xF0E442FF, 0xE56AB3FF, 0xFF7043FF, 0xB39DFFFF)
DRIVEN = 0x8A93A6FF  # odometry before correction: present, not loud
ACCEPTED, REFUSED = 0x3DDC84FF, 0xFF525280
KEYPOINT = 0x3DFFB0FF
AXES = np.array([0xFF5C5CFF, 0x5CE06EFF, 0x5CA8FFFF], dtype=np.uint32)  # x, y, z
ROBOT = 0xFFFFFFFF

Ramp = Literal["turbo", "viridis", "inferno"]


def mission_color(number: int) -> int:
    """Return the colour of the n-th mission."""
    return MISSIONS[number % len(MISSIONS)]


@cache
def _table(ramp: Ramp) -> ColorArray:
    """Return a ramp's 256 colours."""
    import cv2  # noqa: PLC0415  # heavy, and only needed once something is drawn

    names = {"turbo": cv2.COLORMAP_TURBO, "viridis": cv2.COLORMAP_VIRIDIS}
    number = names.get(ramp, cv2.COLORMAP_INFERNO)
    bgr = cv2.applyColorMap(np.arange(256, dtype=np.uint8), number).reshape(256, 3)
    b, g, r = np.moveaxis(bgr.astype(np.uint32), -1, 0)
    return _packed(r, g, b, np.full_like(r, 0xFF))


def ramp_colors(
    values: npt.NDArray[np.floating], low: float, high: float, ramp: Ramp = "turbo"
) -> ColorArray:
    """Return colours (N,) of values (N,): `low` at the ramp's start, `high` at its end."""
    scale = 255 / (high - low) if high > low else 0.0
    index = np.clip((values - low) * scale, 0, 255)
    colors: ColorArray = _table(ramp)[np.nan_to_num(index).astype(np.uint8)]
    return colors


def photographed(colors: ColorArray, rgba: npt.NDArray[np.uint8]) -> ColorArray:
    """Return colours (N,) where those that cameras saw (N, 4) take the place of others."""
    seen = _packed(*np.moveaxis(rgba.astype(np.uint32), -1, 0))
    mixed: ColorArray = np.where(rgba[:, 3] > 0, seen, colors)
    return mixed


def switch_colors(switches: npt.NDArray[np.floating]) -> ColorArray:
    """Return colours (N,) of switch values (N,): red where an edge is off (0), green where on (1)."""
    on = np.clip(np.nan_to_num(switches), 0, 1)
    channels = [
        ((off >> shift) & 0xFF) * (1 - on) + ((is_on >> shift) & 0xFF) * on
        for shift in (24, 16, 8, 0)
        for off, is_on in [(REFUSED, ACCEPTED)]
    ]
    r, g, b, a = (np.round(channel).astype(np.uint32) for channel in channels)
    return _packed(r, g, b, a)


def _packed(r: ColorArray, g: ColorArray, b: ColorArray, a: ColorArray) -> ColorArray:
    return np.asarray((r << 24) | (g << 16) | (b << 8) | a, dtype=np.uint32)
