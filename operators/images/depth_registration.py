"""Depth as the colour camera would have measured it: each pixel moved, the nearest wins."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.depth import depth_m_of
from mapstream.operators.images.pinhole_maps import calibration_key
from mapstream.operators.operator import Operator, OperatorConfig, offload, warn
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project, unproject
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.sync import anchored, nearest

_MM_PER_M = 1000


class DepthRegistrationConfig(OperatorConfig):
    """Options of `depth_registration`."""

    tolerance_s: PositiveFloat = Field(
        default=0.05, description="how far an image of the colour camera may be from the depth"
    )
    least_depth_m: PositiveFloat = Field(default=0.2, description="nearer depth is none")
    most_depth_m: PositiveFloat = Field(default=20.0, description="farther depth is none")


@dataclass(frozen=True)
class Inputs:
    """The colour camera's images are asked only for their calibration and place."""

    depth: Receiver[CameraFrame]
    frames: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    """Depth at its own stamps, in the frame, the place and the calibration of the colour camera."""

    depth: Sender[CameraFrame]


class DepthRegistration(Operator[Inputs, Outputs]):
    """Move depth into the colour camera, by both calibrations and places.

    A pixel covers as many of the new pixels as it is wide. Motion between the two stamps is not undone.
    """

    placement = "thread"

    def __init__(self, config: DepthRegistrationConfig) -> None:
        self._config = config
        self._rays: dict[tuple[object, ...], FloatArray] = {}

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        within_ns = round(self._config.tolerance_s * 1e9)
        pairs = anchored(inputs.depth, nearest(inputs.frames, within_ns))
        async for depth, frame in pairs:
            await outputs.depth.send(await offload(self.registered, depth, frame))
        if pairs.stats.unmatched:
            warn(pairs.explain())

    def registered(self, depth: CameraFrame, frame: CameraFrame) -> CameraFrame:
        """Return the depth in the camera of another frame.

        Raises:
            OperatorError: If a calibration is missing, or there is no depth.
        """
        old, new = require_camera(depth), require_camera(frame)
        config = self._config
        depth_m = depth_m_of(depth, least_m=config.least_depth_m, most_m=config.most_depth_m)
        is_seen = np.isfinite(depth_m).ravel()
        points_old = self._rays_of(old)[is_seen] * depth_m.ravel()[is_seen, None]
        T_new_old = frame.T_base_sensor.inverse() @ depth.T_base_sensor
        points_new = points_old @ T_new_old.R.T + T_new_old.t
        moved_m = _drawn(points_new, new, _width_px(old, new))
        is_mm = depth.encoding == "16UC1"
        return replace(
            depth,
            image=np.round(np.nan_to_num(moved_m) * _MM_PER_M).astype(np.uint16)
            if is_mm
            else moved_m,
            frame=frame.frame,
            T_base_sensor=frame.T_base_sensor,
            camera=new,
            record=None,  # what lies there is not registered
        )

    def _rays_of(self, camera: CameraCalibration) -> FloatArray:
        """Return the points of depth 1 m (H * W, 3) of all pixels; NaN where none is seen."""
        key = calibration_key(camera)
        if key not in self._rays:
            x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
            rays = unproject(camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64))
            self._rays[key] = rays / rays[:, 2:]
        return self._rays[key]


def _width_px(old: CameraCalibration, new: CameraCalibration) -> int:
    """Return how many new pixels an old one is wide."""
    return int(np.ceil(float((new.focal_px / old.focal_px).max()) - 1e-9))


def _drawn(points: FloatArray, camera: CameraCalibration, width_px: int) -> Float32Array:
    """Return the depth image (H, W) of points (N, 3) in the camera's frame; NaN where there is none."""
    px, is_seen = project(camera, points)
    corners = np.round(px[is_seen] - (width_px - 1) / 2).astype(np.int64)
    depth_m = points[is_seen, 2].astype(np.float32)
    image = np.full((camera.height_px, camera.width_px), np.inf, np.float32)
    for dy in range(width_px):
        for dx in range(width_px):
            x, y = corners[:, 0] + dx, corners[:, 1] + dy
            inside = (x >= 0) & (x < camera.width_px) & (y >= 0) & (y < camera.height_px)
            np.minimum.at(image, (y[inside], x[inside]), depth_m[inside])
    return np.where(np.isfinite(image), image, np.float32(np.nan))
