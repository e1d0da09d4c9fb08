"""Keypoints of a LiDAR with their 3D points (Cramariuc et al., maplab 2.0, RA-L 2023, section IV-C)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
from pydantic import Field, NonNegativeFloat

from mapstream.operators.features.rows import rows_of
from mapstream.operators.lidar.images.finders import FinderConfig, ImageFinder
from mapstream.operators.lidar.images.grid import ProjectedScan
from mapstream.operators.lidar.images.lidar_image import LidarImage, LidarImageConfig
from mapstream.operators.operator import Operator, Placement, offload, warn
from mapstream.streams.arrays import BoolArray, IntArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.sensors import CameraFrame, LidarScan
from mapstream.streams.messages.vision import ImageFeatures
from mapstream.streams.sync import exact

_AROUND = np.indices((3, 3)).reshape(2, -1) - 1  # rows and columns from a pixel to those around it


class LidarKeypointsConfig(FinderConfig):
    """Options of `lidar_keypoints`."""

    image: LidarImageConfig = Field(default_factory=LidarImageConfig)
    """In which they are found."""
    max_step: NonNegativeFloat = 0.1
    """By which share of itself the range may change around a keypoint: at an edge it is of one side or the other,
    and moves from the one to the other when the sensor does."""
    sigma_m: NonNegativeFloat = 0.02
    """Uncertainty of a range."""


@dataclass(frozen=True)
class Inputs:
    """Scans of one LiDAR; and their images, where another operator paints or changes them."""

    scans: Receiver[LidarScan]
    frames: Receiver[CameraFrame] | None = None


@dataclass(frozen=True)
class Outputs:
    """One message for each scan, at the scan's end, as odometries have it."""

    features: Sender[ImageFeatures]


class LidarKeypoints(Operator[Inputs, Outputs]):
    """Find keypoints in the image of each scan: each with its 3D point, and its time within the sweep.

    A keypoint is where the scan has a point, never where the image is painted over.
    Images may come from `lidar_image`, of the same options, or from what follows it; without, they are painted here.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: LidarKeypointsConfig) -> None:
        self._config = config
        self._image = LidarImage(config.image)
        self._finder = ImageFinder(config)

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        cv2.setNumThreads(1)  # operators run beside each other
        if inputs.frames is None:
            async for scan in inputs.scans:
                await self._send(outputs, await offload(self.detect, scan))
            return
        pairs = exact(inputs.scans, inputs.frames)
        async for scan, frame in pairs:
            await self._send(outputs, await offload(self.detect, scan, frame))
        if pairs.stats.unmatched:
            warn(pairs.explain())

    async def _send(self, outputs: Outputs, features: ImageFeatures) -> None:
        if not len(features):
            warn(f"scans of {features.frame} without a keypoint")
        await outputs.features.send(features)

    def detect(self, scan: LidarScan, frame: CameraFrame | None = None) -> ImageFeatures:
        """Return the keypoints of the next scan, the strongest first; times count from the scan's end.

        Args:
            scan: The scan.
            frame: Its image; painted here without.

        Raises:
            OperatorError: If the image is not of the size that this operator would paint.
        """
        projected = self._image.project(scan)
        frame = frame or self._image.painted(projected)
        if frame.image.shape != projected.point.shape:
            raise OperatorError(
                f"{frame.frame}: the image has {frame.image.shape} pixels, its scan {projected.point.shape}; "
                "give lidar_keypoints the `rows` and `columns` of lidar_image, under `image`"
            )
        return self._located(self._finder.find(frame), projected)

    def _located(self, found: ImageFeatures, projected: ProjectedScan) -> ImageFeatures:
        """Return the keypoints that are on points of the scan, with these and their times."""
        scan = projected.scan
        column_row = np.rint(found.keypoints_px).astype(np.int64)
        column, row = column_row[:, 0] % projected.point.shape[1], column_row[:, 1]
        kept = np.flatnonzero(self._is_smooth(projected, column, row))
        point = projected.point[row[kept], column[kept]]
        range_m = projected.range_m[row[kept], column[kept]]
        offsets_ns = np.zeros(len(scan.points), np.int64)
        if scan.offsets_ns is not None:
            offsets_ns = scan.offsets_ns - (scan.end_ns - scan.stamp_ns)
        return replace(
            rows_of(found, kept),
            stamp_ns=scan.end_ns,
            points_m=scan.points[point],
            point_sigmas_m=np.hypot(self._config.sigma_m, range_m * projected.pixel_rad / 2),
            offsets_ns=offsets_ns[point],
        )

    def _is_smooth(self, projected: ProjectedScan, column: IntArray, row: IntArray) -> BoolArray:
        """Return which pixels (N,) have a point, and around them a surface without an edge."""
        height, width = projected.point.shape
        rows = np.clip(row[:, None] + _AROUND[0], 0, height - 1)
        columns = (column[:, None] + _AROUND[1]) % width
        around_m = projected.range_m[rows, columns]
        nearest_m = np.where(around_m > 0, around_m, np.inf).min(axis=1)
        rise_m = around_m.max(axis=1) - nearest_m
        is_smooth: BoolArray = rise_m <= self._config.max_step * nearest_m
        return is_smooth & (projected.point[row, column] >= 0)
