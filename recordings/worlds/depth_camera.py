"""A simulated depth camera: a grid of rays through one point, with the noise of structured light."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.streams.arrays import FloatArray
from mapstream.streams.messages.sensors import LidarScan
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
        u = (np.arange(config.columns) + 0.5 - config.columns / 2) / focal
        v = (np.arange(config.rows) + 0.5 - config.rows / 2) / focal
        x, y = (axis.ravel() for axis in np.meshgrid(u, v))
        self._rays = np.stack([x, y, np.ones_like(x)], axis=1)  # (N, 3) of depth 1

    def cloud(self, caster: RayCaster, T_world_camera: FloatArray, stamp_ns: int) -> LidarScan:
        """Return what is seen from a pose (4, 4), row by row, without the pixels that see nothing."""
        config = self.config
        lengths = np.linalg.norm(self._rays, axis=1)
        directions = (self._rays / lengths[:, None]) @ T_world_camera[:3, :3].T
        origins = np.broadcast_to(T_world_camera[:3, 3], directions.shape)
        depth_m = caster.cast(np.ascontiguousarray(origins), directions).ranges_m / lengths
        seen = (depth_m >= config.min_depth_m) & (depth_m <= config.max_depth_m)
        depth_m = with_depth_noise(depth_m[seen], config.noise, self._rng)
        return LidarScan(
            stamp_ns=stamp_ns, points=depth_m[:, None] * self._rays[seen], frame=self.frame
        )
