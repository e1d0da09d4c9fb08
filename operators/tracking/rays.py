"""Rays of pixels, fast: a table of each camera, made once and blended.

The exact inverse of a lens costs 20 us a pixel, and a tracker asks for thousands of pixels a second. Blended
over 4 px a ray is wrong by about a hundredth of a pixel, far below what a tracker measures.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.operators.images.pinhole_maps import calibration_key
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import unproject

_SPACING_PX = 4


@dataclass(frozen=True, slots=True)
class _Lens:
    """A camera that equals another with the same parameters, whichever message it came with."""

    key: tuple[object, ...]
    camera: CameraCalibration = field(compare=False)


def rays(camera: CameraCalibration, px: npt.NDArray[np.floating]) -> FloatArray:
    """Return the unit rays (N, 3) of pixels (N, 2) inside the image; NaN where there is none."""
    if len(px) == 0:
        return np.empty((0, 3))
    at = (px / _SPACING_PX).astype(np.float32)
    table = _table(_Lens(calibration_key(camera), camera))
    blended = cv2.remap(
        table, at[:, :1], at[:, 1:], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    found = blended.reshape(-1, 3).astype(np.float64)
    unit: FloatArray = found / np.linalg.norm(found, axis=1, keepdims=True)
    return unit


@lru_cache(maxsize=32)
def _table(lens: _Lens) -> Float32Array:
    """Return the rays (H, W, 3) of every fourth pixel, the last one beyond the image's edge."""
    camera = lens.camera
    columns = np.arange(0, camera.width_px + _SPACING_PX, _SPACING_PX)
    rows = np.arange(0, camera.height_px + _SPACING_PX, _SPACING_PX)
    nodes = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    table = unproject(camera, nodes.astype(np.float64)).reshape(len(rows), len(columns), 3)
    return table.astype(np.float32)
