"""What a pixel of a depth image says: how far away something is, and where."""

from __future__ import annotations

import numpy as np

from mapstream.operators.images.frame_filter import DEPTHS, require_encoding
from mapstream.operators.images.pinhole_maps import calibration_key
from mapstream.streams.arrays import Float32Array
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import unproject
from mapstream.streams.messages.sensors import CameraFrame


def depth_m_of(frame: CameraFrame, *, least_m: float = 0.0, most_m: float = np.inf) -> Float32Array:
    """Return depth along the view (H, W) [m]; NaN where nothing was seen, or out of range.

    Raises:
        OperatorError: If it is no depth image.
    """
    require_encoding(frame, "depth", DEPTHS)
    depth_m = frame.image.astype(np.float32)
    if frame.encoding == "16UC1":
        depth_m /= 1000.0
    with np.errstate(invalid="ignore"):
        is_seen = (depth_m > least_m) & (depth_m < most_m)
    return np.where(is_seen, depth_m, np.float32(np.nan))


class PixelRays:
    """The points of depth 1 m of all pixels; made anew for another calibration only."""

    def __init__(self) -> None:
        self._key: tuple[object, ...] | None = None
        self._rays: Float32Array = np.empty((0, 0, 3), np.float32)

    def of(self, camera: CameraCalibration) -> Float32Array:
        """Return them (H, W, 3), with z = 1, in the camera's frame."""
        key = calibration_key(camera)
        if key != self._key:
            x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
            rays = unproject(camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64))
            size = (camera.height_px, camera.width_px, 3)
            self._key, self._rays = key, (rays / rays[:, 2:]).astype(np.float32).reshape(size)
        return self._rays
