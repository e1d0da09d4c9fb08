"""The camera whose pixels an organised cloud was made of, from the cloud itself.

With a pinhole x / z is linear in the column, and y / z in the row.
"""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import EstimationError

_LEAST_POINTS = 100
_LEAST_SPAN = 0.2  # of the rows and of the columns, that are needed to tell a line


def grid_camera(points: Float32Array, frame: str, max_off_px: float) -> CameraCalibration:
    """Return the camera of points (H, W, 3), NaN where nothing was seen.

    Raises:
        EstimationError: If there are too few points, or they are not those of a pinhole's pixels.
    """
    height, width, _ = points.shape
    rows, columns = np.nonzero(np.isfinite(points).all(axis=2) & (points[:, :, 2] > 0))
    if len(rows) < _LEAST_POINTS:
        raise EstimationError(f"{len(rows)} points, {_LEAST_POINTS} are needed")
    if min(np.ptp(rows) / height, np.ptp(columns) / width) < _LEAST_SPAN:
        raise EstimationError("its points are all in a small part of the image")
    seen = points[rows, columns].astype(np.float64)
    slopes = seen[:, :2] / seen[:, 2:]
    fx, cx, off_x = _line(slopes[:, 0], columns)
    fy, cy, off_y = _line(slopes[:, 1], rows)
    off_px = float(np.hypot(off_x, off_y))
    if not (off_px < max_off_px and fx > 0 and fy > 0):
        raise EstimationError(
            f"its points are {off_px:.2f} px off the pixels of the pinhole that fits best (focal length"
            f" {fx:.1f}, {fy:.1f} px), at most {max_off_px} are allowed; give focal_px and center_px, if z"
            " is along the view"
        )
    return CameraCalibration(
        frame=frame,
        width_px=width,
        height_px=height,
        focal_px=np.array([fx, fy]),
        center_px=np.array([cx, cy]),
        distortion_parameters=np.empty(0),
    )


def _line(slopes: FloatArray, px: np.ndarray[tuple[int], np.dtype[np.int64]]) -> tuple[float, ...]:
    """Return f, c of slopes (N,) = (px - c) / f, and the rms distance from it [px]."""
    by_px, at_zero = np.polynomial.polynomial.polyfit(px, slopes, 1)[::-1]
    if by_px == 0:
        return 0.0, 0.0, np.inf
    off = (slopes - at_zero) / by_px - px
    return float(1 / by_px), float(-at_zero / by_px), float(np.sqrt(np.mean(off**2)))
