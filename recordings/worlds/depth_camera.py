"""A simulated depth camera: a grid of rays through one point, with the noise of structured light."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame, LidarScan
from mapstream.streams.structured_light import depth_sigma_m


def with_depth_noise(depth_m: FloatArray, times: float, rng: np.random.Generator) -> FloatArray:
    """Return depths as structured light measures them, with a multiple of its noise."""
    sigma_m = times * depth_sigma_m(depth_m)
    noisy: FloatArray = depth_m + rng.normal(0.0, 1.0, depth_m.shape) * sigma_m
    return noisy


class DepthCameraConfig(BaseModel):
    """A depth camera that measures all its pixels at one time."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    columns: PositiveInt = 80
    rows: PositiveInt = 60
    horizontal_fov_rad: PositiveFloat = float(np.deg2rad(57))
    rate_hz: PositiveFloat = 10.0
    min_depth_m: NonNegativeFloat = 0.5
    max_depth_m: PositiveFloat = 4.0
    noise: NonNegativeFloat = 1.0
    """Times that of structured light."""


class DepthCamera:
    """Its frame has z along the view, x to the right and y down."""

    def __init__(self, config: DepthCameraConfig, frame: str, rng: np.random.Generator) -> None:
        self.config = config
        self.frame = frame
        self._rng = rng
        focal = config.columns / 2 / np.tan(config.horizontal_fov_rad / 2)
        self._focal_px = float(focal)
        u = (np.arange(config.columns) + 0.5 - config.columns / 2) / focal
        v = (np.arange(config.rows) + 0.5 - config.rows / 2) / focal
        x, y = (axis.ravel() for axis in np.meshgrid(u, v))
        self._rays = np.stack([x, y, np.ones_like(x)], axis=1)  # (N, 3) of depth 1

    def cloud(self, caster: RayCaster, T_world_camera: FloatArray, stamp_ns: int) -> LidarScan:
        """Return what is seen from a pose (4, 4), row by row, without the pixels that see nothing."""
        depth_m, seen = self._depths(caster, T_world_camera)
        return LidarScan(
            stamp_ns=stamp_ns, points=depth_m[:, None] * self._rays[seen], frame=self.frame
        )

    def image(
        self, caster: RayCaster, T_world_camera: FloatArray, stamp_ns: int, T_base_sensor: SE3
    ) -> CameraFrame:
        """Return the same as a depth image, 16UC1 [mm]."""
        depth_m, seen = self._depths(caster, T_world_camera)
        pixels = np.zeros(seen.shape, np.uint16)
        pixels[seen] = np.rint(1000 * depth_m)
        return CameraFrame(
            stamp_ns=stamp_ns,
            image=pixels.reshape(self.config.rows, self.config.columns),
            encoding="16UC1",
            frame=self.frame,
            T_base_sensor=T_base_sensor,
            camera=self.calibration,
        )

    @property
    def calibration(self) -> CameraCalibration:
        """Return where its pixels look."""
        config = self.config
        return CameraCalibration(
            frame=self.frame,
            width_px=config.columns,
            height_px=config.rows,
            focal_px=np.full(2, self._focal_px),
            center_px=(np.array([config.columns, config.rows]) - 1) / 2,
            distortion_parameters=np.zeros(0),
        )

    def _depths(
        self, caster: RayCaster, T_world_camera: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Return the depths (M,) that are measured, and of which pixels (N,)."""
        config = self.config
        lengths = np.linalg.norm(self._rays, axis=1)
        directions = (self._rays / lengths[:, None]) @ T_world_camera[:3, :3].T
        origins = np.broadcast_to(T_world_camera[:3, 3], directions.shape)
        depth_m = caster.cast(np.ascontiguousarray(origins), directions).ranges_m / lengths
        seen = (depth_m >= config.min_depth_m) & (depth_m <= config.max_depth_m)
        return with_depth_noise(depth_m[seen], config.noise, self._rng), seen
