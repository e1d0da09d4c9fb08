"""Cameras of every kind, and images whose values tell where their pixels were."""

from __future__ import annotations

from typing import Any

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame

_STEP = 40  # grey values between two columns

LENSES: dict[str, dict[str, Any]] = {
    "none": {"distortion_parameters": np.empty(0)},
    "radtan": {
        "distortion": "radtan",
        "distortion_parameters": np.array([-0.28, 0.07, 0.0002, 0.00002]),
    },
    "equidistant": {
        "distortion": "equidistant",
        "distortion_parameters": np.array([-0.01, 0.02, -0.01, 0.003]),
    },
    "fov": {"distortion": "fov", "distortion_parameters": np.array([0.9])},
    "unified": {"model": "unified", "xi": 0.8, "distortion_parameters": np.empty(0)},
}


def camera(lens: str = "none", **changes: Any) -> CameraCalibration:  # noqa: ANN401
    """Return a camera of 160 x 120 px."""
    given: dict[str, Any] = {
        "frame": "cam",
        "width_px": 160,
        "height_px": 120,
        "focal_px": np.array([110.0, 112.0]),
        "center_px": np.array([78.0, 61.0]),
    }
    return CameraCalibration(**given | LENSES[lens] | changes)


def frame(
    image: np.ndarray,
    encoding: str,
    calibration: CameraCalibration | None = None,
    place: SE3 | None = None,
    stamp_ns: int = 7,
) -> CameraFrame:
    """Return an image of that camera."""
    return CameraFrame(
        stamp_ns=stamp_ns,
        image=image,
        encoding=encoding,
        frame="cam" if calibration is None else calibration.frame,
        T_base_sensor=place or SE3.identity(),
        camera=calibration,
    )


def ramp(calibration: CameraCalibration) -> CameraFrame:
    """Return an image whose value is a linear function of the place of the pixel."""
    x, y = np.meshgrid(np.arange(calibration.width_px), np.arange(calibration.height_px))
    image = (_STEP * (200 + x + 3 * y)).astype(np.uint16)
    return frame(image, "mono16", calibration)


def ramp_at(px: FloatArray) -> FloatArray:
    """Return what `ramp` has at places (N, 2)."""
    values: FloatArray = _STEP * (200 + px[:, 0] + 3 * px[:, 1])
    return values


def sampled(image: np.ndarray, px: FloatArray) -> FloatArray:
    """Return an image's values between pixels (N, 2)."""
    x, y = np.floor(px).astype(int).T
    fx, fy = (px - np.floor(px)).T
    rows = image.astype(np.float64)
    top = rows[y, x] * (1 - fx) + rows[y, x + 1] * fx
    bottom = rows[y + 1, x] * (1 - fx) + rows[y + 1, x + 1] * fx
    values: FloatArray = top * (1 - fy) + bottom * fy
    return values


def points_before(count: int, seed: int = 0) -> FloatArray:
    """Return points (N, 3) that such a camera sees well inside its image."""
    rng = np.random.default_rng(seed)
    depths = rng.uniform(1, 10, (count, 1))
    return np.hstack([rng.uniform(-0.45, 0.45, (count, 1)), rng.uniform(-0.3, 0.3, (count, 1)),
                      np.ones((count, 1))]) * depths  # fmt: skip
