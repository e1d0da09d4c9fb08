"""Two cameras turned to look the same way, so that a point has one row in both images.

Source: Fusiello, Trucco and Verri, A compact algorithm for rectification of stereo pairs,
Machine Vision and Applications 12, 2000.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.pinhole_maps import (
    PinholeMap,
    calibration_key,
    pinhole_like,
    pinhole_map,
)
from mapstream.operators.operator import Operator, OperatorConfig, offload, warn
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.sync import approximate

_LEAST_BASELINE_M = 1e-4


class RectifyConfig(OperatorConfig):
    """Options of `rectify`."""

    tolerance_s: PositiveFloat = Field(
        default=0.0005, description="how far the images of a pair may be apart"
    )
    zoom: PositiveFloat = Field(default=1.0, description="as of `undistort`")


@dataclass(frozen=True)
class Inputs:
    left: Receiver[CameraFrame]
    right: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    """Pairs; both cameras are one pinhole camera in two places, their x axis along the baseline."""

    left: Sender[CameraFrame]
    right: Sender[CameraFrame]


class Rectify(Operator[Inputs, Outputs]):
    """Rectify stereo pairs by the calibrations and places of their cameras. An image alone is counted."""

    placement = "thread"

    def __init__(self, config: RectifyConfig) -> None:
        self._config = config
        self._maps: dict[tuple[object, ...], tuple[PinholeMap, PinholeMap]] = {}

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        pairs = approximate(
            inputs.left, inputs.right, within_ns=round(self._config.tolerance_s * 1e9)
        )
        async for left, right in pairs:
            rectified = await offload(self.rectified, left, right)
            await outputs.left.send(rectified[0])
            await outputs.right.send(rectified[1])
        if pairs.stats.unmatched:
            warn(pairs.explain())

    def rectified(self, left: CameraFrame, right: CameraFrame) -> tuple[CameraFrame, CameraFrame]:
        """Return a pair as the turned cameras would have seen it.

        Raises:
            OperatorError: If a calibration is missing, or both cameras sit at one place.
        """
        places = [frame.T_base_sensor.matrix for frame in (left, right)]
        cameras = require_camera(left), require_camera(right)
        key = (*map(calibration_key, cameras), *(place.tobytes() for place in places))
        if key not in self._maps:
            new = _common(*(pinhole_like(camera, self._config.zoom) for camera in cameras))
            R_base_new = _turned(left, right)
            first, second = (
                pinhole_map(camera, new, place[:3, :3].T @ R_base_new)
                for camera, place in zip(cameras, places, strict=True)
            )
            self._maps[key] = first, second
        maps = self._maps[key]
        return _named(maps[0].warped(left)), _named(maps[1].warped(right))


def _turned(left: CameraFrame, right: CameraFrame) -> FloatArray:
    """Return R_base_camera (3, 3) of both: x along the baseline, z between where they look."""
    baseline = right.T_base_sensor.t - left.T_base_sensor.t
    length_m = float(np.linalg.norm(baseline))
    if length_m < _LEAST_BASELINE_M:
        raise OperatorError(
            f"{left.frame} and {right.frame} sit at one place ({length_m * 1000:.3f} mm apart): give the source"
            " of the recording a rig that says where they are"
        )
    x = baseline / length_m
    if x @ left.T_base_sensor.R[:, 0] <= 0:
        raise OperatorError(
            f"{right.frame} sits to the left of {left.frame}; exchange the inputs of `rectify`"
        )
    view = left.T_base_sensor.R[:, 2] + right.T_base_sensor.R[:, 2]
    y = np.cross(view, x)
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def _common(left: CameraCalibration, right: CameraCalibration) -> CameraCalibration:
    """Return one camera for both, with square pixels."""
    focal_px = min(*left.focal_px, *right.focal_px)
    return replace(
        left,
        focal_px=np.full(2, focal_px),
        center_px=(left.center_px + right.center_px) / 2,
    )


def _named(frame: CameraFrame) -> CameraFrame:
    """Let the calibration bear its own camera's name."""
    if frame.camera is None or frame.camera.frame == frame.frame:
        return frame
    return replace(frame, camera=replace(frame.camera, frame=frame.frame))
