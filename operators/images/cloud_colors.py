"""Colours for the points of a cloud, from a camera that saw them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.decode.image import ImageDecode, ImageDecodeConfig
from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.odometry.moved import moved
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.sync import anchored, nearest, window

_TO_COLOR = ImageDecode(ImageDecodeConfig(mode="color"))


class CloudColorsConfig(OperatorConfig):
    """Options of `cloud_colors`."""

    tolerance_s: PositiveFloat = 0.1
    """How far an image may be from the cloud."""
    cell_px: PositiveInt = Field(default=8, le=128)
    """Points within so many pixels of each other hide those behind them."""
    hidden_m: PositiveFloat = 0.3
    """So far behind the nearest point around it, a point is hidden; grows by a fiftieth of the depth."""


@dataclass(frozen=True)
class Inputs:
    """Clouds, images with their calibration, and how the robot moved between the two."""

    clouds: Receiver[PointCloud]
    frames: Receiver[CameraFrame]
    odometry: Receiver[Odometry] | None = None


@dataclass(frozen=True)
class Outputs:
    """The clouds as they came, with colours where the camera saw a point that had none."""

    clouds: Sender[PointCloud]


class CloudColors(Operator[Inputs, Outputs]):
    """Give each point the colour of the pixel in which it is seen; one operator per camera, in a chain.

    A point behind others gets none: its pixel shows what is in front of it. Without `odometry` the robot
    counts as standing between the cloud and the image. A cloud without an image goes on without colours.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: CloudColorsConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        within_ns = round(self._config.tolerance_s * 1e9)
        frames = nearest(inputs.frames, within_ns, optional=True)
        poses = window(inputs.odometry, within_ns, within_ns, cover=False, optional=True)
        async for cloud, frame, odometry in anchored(inputs.clouds, frames, poses):
            if frame is None:
                warn("clouds without an image near their stamp keep no colours")
                await outputs.clouds.send(cloud)
            else:
                await outputs.clouds.send(await offload(self.colored, cloud, frame, odometry or ()))

    def colored(
        self, cloud: PointCloud, frame: CameraFrame, odometry: Sequence[Odometry] = ()
    ) -> PointCloud:
        """Return the cloud with the colours of one image.

        Raises:
            OperatorError: If the image has no calibration, or no colours and no grey of 8 bits.
        """
        camera = require_camera(frame)
        decoded = _TO_COLOR.decode(frame)
        if not isinstance(decoded, CameraFrame):
            raise OperatorError(f"{frame.frame} gives no colours: {decoded.reason}")
        T_camera_base = frame.T_base_sensor.inverse() @ moved(
            odometry, frame.stamp_ns, cloud.stamp_ns
        )
        points = cloud.points.astype(np.float64) @ T_camera_base.R.T + T_camera_base.t
        px, is_seen = project(camera, points)
        is_seen &= ((px >= 0) & (px <= np.array([camera.width_px, camera.height_px]) - 1)).all(
            axis=1
        )
        is_seen[is_seen] = self._is_in_front(px[is_seen], points[is_seen, 2], camera)
        rgba = np.zeros((len(points), 4), np.uint8)
        if cloud.colors_rgba is not None:
            rgba[:] = cloud.colors_rgba
        rows = np.flatnonzero(is_seen & (rgba[:, 3] == 0))
        rgba[rows, :3] = _sampled(decoded.image, px[rows])[:, ::-1]
        rgba[rows, 3] = 255
        return replace(cloud, colors_rgba=rgba)

    def _is_in_front(
        self, px: FloatArray, depth_m: FloatArray, camera: CameraCalibration
    ) -> BoolArray:
        """Return which points nothing around their pixel hides."""
        size = self._config.cell_px
        cells = (px / size).astype(np.int64)
        shape = (camera.height_px // size + 1, camera.width_px // size + 1)
        nearest_m = np.full(shape, np.inf, np.float32)
        np.minimum.at(nearest_m, (cells[:, 1], cells[:, 0]), depth_m.astype(np.float32))
        around = cv2.erode(nearest_m, np.ones((3, 3), np.uint8))  # the least of the cells around
        front_m = around[cells[:, 1], cells[:, 0]]
        in_front: BoolArray = depth_m <= 1.02 * front_m + self._config.hidden_m
        return in_front


def _sampled(image: npt.NDArray[np.uint8], px: FloatArray) -> npt.NDArray[np.uint8]:
    """Return colours (N, 3) of pixels (N, 2), interpolated."""
    if not len(px):
        return np.empty((0, 3), np.uint8)
    at = px.astype(np.float32)
    width = 1 << 14  # remap takes images up to 2**15 in each direction
    rows = [
        cv2.remap(image, part[None, :, 0], part[None, :, 1], cv2.INTER_LINEAR)[0]
        for part in np.array_split(at, -(-len(at) // width))
    ]
    return np.concatenate(rows)
