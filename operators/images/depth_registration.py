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
        self._rays: dict[tuple[object, ...], Float32Array] = {}

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
        T_new_old = frame.T_base_sensor.inverse() @ depth.T_base_sensor
        rays = self._rays_of(old, T_new_old.R)
        points = rays * depth_m.ravel() + T_new_old.t.astype(np.float32)[:, None]
        moved_m = _drawn(points, new, _width_px(old, new))
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

    def _rays_of(self, camera: CameraCalibration, R_new_old: FloatArray) -> Float32Array:
        """Return the points of depth 1 m (3, H * W) of all pixels, turned; NaN where none is seen."""
        key = (*calibration_key(camera), R_new_old.tobytes())
        if key not in self._rays:
            x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
            rays = unproject(camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64))
            self._rays[key] = (R_new_old @ (rays / rays[:, 2:]).T).astype(np.float32)
        return self._rays[key]


def _width_px(old: CameraCalibration, new: CameraCalibration) -> int:
    """Return how many new pixels an old one is wide."""
    return int(np.ceil(float((new.focal_px / old.focal_px).max()) - 1e-9))


def _drawn(points: Float32Array, camera: CameraCalibration, width_px: int) -> Float32Array:
    """Return the depth image (H, W) of points (3, N) in the camera's frame; NaN where there is none."""
    left, top = np.floor(_pixels(points, camera) - np.float32(width_px / 2 - 1))
    image = np.full(camera.height_px * camera.width_px, np.inf, np.float32)
    for dy in range(width_px):
        for dx in range(width_px):
            with np.errstate(invalid="ignore"):  # what is not seen is nowhere
                inside = (left >= -dx) & (left < camera.width_px - dx)
                inside &= (top >= -dy) & (top < camera.height_px - dy)
            x, y = left[inside].astype(np.int64) + dx, top[inside].astype(np.int64) + dy
            np.minimum.at(image, y * camera.width_px + x, points[2, inside])
    image[np.isinf(image)] = np.nan
    return image.reshape(camera.height_px, camera.width_px)


def _pixels(points: Float32Array, camera: CameraCalibration) -> Float32Array:
    """Return the pixels (2, N) of points (3, N); NaN where there is none."""
    if (camera.model, camera.distortion) != ("pinhole", "none"):
        return project(camera, points.T.astype(np.float64))[0].T.astype(np.float32)
    scale = camera.focal_px.astype(np.float32)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m: Float32Array = np.where(points[2] > 0, points[2], np.float32(np.nan))
        px = (points[:2] / depth_m * scale).astype(np.float32, copy=False)
    return px + camera.center_px.astype(np.float32)[:, None]
