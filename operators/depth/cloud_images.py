"""Organised clouds as the depth and colour images that they were made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import PositiveFloat, model_validator

from mapstream.operators.depth.grid_camera import grid_camera
from mapstream.operators.operator import (
    Operator,
    OperatorConfig,
    Placement,
    offload,
    report_loss,
)
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError
from mapstream.streams.messages.sensors import CameraFrame, OrganizedCloud


class CloudImagesConfig(OperatorConfig):
    """Options of `cloud_images`; a calibration that is not given is taken from the clouds themselves."""

    focal_px: tuple[PositiveFloat, PositiveFloat] | None = None
    """Of the camera whose pixels the points are, along rows and columns."""
    center_px: tuple[float, float] | None = None
    """Of its image: column and row of the view straight ahead."""
    max_off_px: PositiveFloat = 0.5
    """So far from their pixels points of clouds without a given calibration may lie, in the mean."""

    @model_validator(mode="after")
    def _check_both(self) -> CloudImagesConfig:
        if (self.focal_px is None) != (self.center_px is None):
            raise ValueError("give both focal_px and center_px, or neither")
        return self


@dataclass(frozen=True)
class Inputs:
    """Clouds with rows and columns: `{organized: /points}` of the source of a recording."""

    organized: Receiver[OrganizedCloud]


@dataclass(frozen=True)
class Outputs:
    """Both with the calibration; the depth is registered to the colours, for they are of the same pixels."""

    depth: Sender[CameraFrame]  # 32FC1 [m]
    frames: Sender[CameraFrame]  # rgb8, where the clouds have colours


class CloudImages(Operator[Inputs, Outputs]):
    """Make images of organised clouds, so that all that works on colour and depth works on them."""

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: CloudImagesConfig) -> None:
        self._config = config
        self._cameras: dict[tuple[str, int, int], CameraCalibration] = {}

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async for cloud in inputs.organized:
            try:
                depth, color = await offload(self.images, cloud)
            except EstimationError as error:
                report_loss(f"organised clouds of {cloud.frame} without a calibration: {error}")
                continue
            await outputs.depth.send(depth)
            if color is not None:
                await outputs.frames.send(color)

    def images(self, cloud: OrganizedCloud) -> tuple[CameraFrame, CameraFrame | None]:
        """Return the depth image, and the colour image if there is one.

        Raises:
            EstimationError: If no calibration was given, and neither this cloud nor one before tells it.
        """
        camera = self._camera(cloud)
        depth = CameraFrame(
            stamp_ns=cloud.stamp_ns,
            image=np.ascontiguousarray(cloud.points[:, :, 2]),
            encoding="32FC1",
            frame=cloud.frame,
            T_base_sensor=cloud.T_base_sensor,
            camera=camera,
        )
        if cloud.colors_rgb is None:
            return depth, None
        color = CameraFrame(
            stamp_ns=cloud.stamp_ns,
            image=cloud.colors_rgb,
            encoding="rgb8",
            frame=cloud.frame,
            T_base_sensor=cloud.T_base_sensor,
            camera=camera,
        )
        return depth, color

    def _camera(self, cloud: OrganizedCloud) -> CameraCalibration:
        height, width, _ = cloud.points.shape
        key = (cloud.frame, width, height)
        if key not in self._cameras:
            focal_px, center_px = self._config.focal_px, self._config.center_px
            if focal_px is not None and center_px is not None:
                self._cameras[key] = CameraCalibration(
                    frame=cloud.frame,
                    width_px=width,
                    height_px=height,
                    focal_px=np.array(focal_px),
                    center_px=np.array(center_px),
                    distortion_parameters=np.empty(0),
                )
            else:
                found = grid_camera(cloud.points, cloud.frame, self._config.max_off_px)
                self._cameras[key] = found
        return self._cameras[key]
