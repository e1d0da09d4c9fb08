"""Depth images as clouds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.depth import PixelRays, depth_m_of
from mapstream.operators.lidar.sampling import voxel_indices
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.estimates import PointCloud
from mapstream.streams.messages.sensors import CameraFrame


class DepthCloudConfig(OperatorConfig):
    """Options of `depth_cloud`."""

    every_px: PositiveInt = 2
    """So many rows and columns make one point."""
    voxel_size_m: PositiveFloat | None = None
    """One point for each cell of this size; `null`: all of them."""
    min_depth_m: NonNegativeFloat = 0.3
    max_depth_m: PositiveFloat = 5.0


@dataclass(frozen=True)
class Inputs:
    """Depth images with their calibration."""

    depth: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    """What they show, in the base frame."""

    clouds: Sender[PointCloud]


class DepthCloud(Operator[Inputs, Outputs]):
    """Make clouds of depth images, for whatever takes the clouds of a LiDAR."""

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: DepthCloudConfig) -> None:
        self._config = config
        self._rays = PixelRays()

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for depth in inputs.depth:
            await outputs.clouds.send(await offload(self.cloud, depth))

    def cloud(self, depth: CameraFrame) -> PointCloud:
        """Return the points of an image.

        Raises:
            OperatorError: If it has no calibration.
        """
        config, every = self._config, self._config.every_px
        rays = self._rays.of(require_camera(depth))[::every, ::every]
        depth_m = depth_m_of(depth, least_m=config.min_depth_m, most_m=config.max_depth_m)
        depth_m = depth_m[::every, ::every]
        is_seen = np.isfinite(depth_m)
        in_camera = (rays[is_seen] * depth_m[is_seen, None]).astype(np.float64)
        points = depth.T_base_sensor @ in_camera
        if config.voxel_size_m is not None:
            points = points[voxel_indices(points, config.voxel_size_m)]
        return PointCloud(
            stamp_ns=depth.stamp_ns, points=points.astype(np.float32), record=depth.record
        )
