"""What a pixel of a depth image says."""

from __future__ import annotations

import numpy as np

from mapstream.operators.images.frame_filter import DEPTHS, require_encoding
from mapstream.streams.arrays import Float32Array
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
