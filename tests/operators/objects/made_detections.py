"""Detections made by hand, of a camera of 64 x 48 pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.messages.objects import ObjectDetections

CAMERA = CameraCalibration(
    frame="camera",
    model="pinhole",
    width_px=64,
    height_px=48,
    focal_px=np.array([50.0, 50.0]),
    center_px=np.array([31.5, 23.5]),
    distortion_parameters=np.empty(0),
)


def detections(
    boxes_px: Sequence[tuple[float, float, float, float]],
    stamp_ns: int = 10,
    **more: Any,  # noqa: ANN401  # its fields
) -> ObjectDetections:
    """Objects in these boxes: cups, unless something else is said."""
    n = len(boxes_px)
    given: dict[str, Any] = {
        "labels": ("cup",) * n,
        "scores": np.full(n, 0.9, np.float32),
        "track_ids": np.arange(n),
        "camera": CAMERA,
    }
    return ObjectDetections(
        stamp_ns=stamp_ns,
        frame="camera",
        width_px=64,
        height_px=48,
        boxes_px=np.array(boxes_px, np.float32).reshape(-1, 4),
        **given | more,
    )
