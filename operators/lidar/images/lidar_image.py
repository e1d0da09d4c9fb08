"""LiDAR scans as images, to look at and for whatever works on images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import cv2

from mapstream.operators.lidar.images.grid import ProjectedScan, ScanGrid
from mapstream.operators.lidar.images.picture import Painter, PictureConfig
from mapstream.operators.operator import Operator, Placement, offload
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.sensors import CameraFrame, LidarScan


class LidarImageConfig(PictureConfig):
    """Options of `lidar_image`."""


@dataclass(frozen=True)
class Inputs:
    """Scans of one LiDAR."""

    scans: Receiver[LidarScan]


@dataclass(frozen=True)
class Outputs:
    """One image for each scan, with its stamp."""

    frames: Sender[CameraFrame]


class LidarImage(Operator[Inputs, Outputs]):
    """Project scans onto their beams and columns, and paint range and intensity as one image without gaps.

    Straight ahead is in the middle of the image, and the highest beam at its top.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: LidarImageConfig) -> None:
        self._grid = ScanGrid(config)
        self._painter = Painter(config)

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        cv2.setNumThreads(1)  # operators run beside each other
        async for scan in inputs.scans:
            await outputs.frames.send(await offload(self.image, scan))

    def image(self, scan: LidarScan) -> CameraFrame:
        """Return the image of the next scan."""
        return self.painted(self.project(scan))

    def project(self, scan: LidarScan) -> ProjectedScan:
        """Return which point of the next scan each pixel shows."""
        return self._grid.project(scan)

    def painted(self, projected: ProjectedScan) -> CameraFrame:
        """Return the image of a projected scan."""
        scan = projected.scan
        return CameraFrame(
            stamp_ns=scan.stamp_ns,
            image=self._painter.paint(projected),
            encoding="mono8",
            frame=scan.frame,
            T_base_sensor=scan.T_base_sensor,
            record=scan.record,
        )
