"""Masks and points of detected objects, from a depth image or from a LiDAR.

Source: the project's own; masks from depth stand in for Mask R-CNN where a network gives boxes alone (maplab 2.0, section IV-D).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.images.depth import PixelRays, depth_m_of
from mapstream.operators.objects.masks.depth_segments import depth_segment
from mapstream.operators.objects.masks.lidar_segments import lidar_segment, seen_points
from mapstream.operators.objects.masks.segment import Segment, center_of, sampled, unsegmented
from mapstream.operators.odometry.moved import moved
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.sync import anchored, nearest, window


class ObjectMasksConfig(OperatorConfig):
    """Options of `object_masks`."""

    max_apart_s: PositiveFloat = 0.06
    """So far depth or a cloud may be from the image: half the period of a LiDAR, and a little more."""
    min_depth_m: NonNegativeFloat = 0.2
    max_depth_m: PositiveFloat = 10.0
    """Of depth images; farther depth is not used."""
    max_points: PositiveInt = 300
    """Kept of each object, evenly spread."""


@dataclass(frozen=True)
class Inputs:
    """Objects, and depth of the same pixels (see `depth_registration`) or clouds in the base frame."""

    detections: Receiver[ObjectDetections]
    depth: Receiver[CameraFrame] | None = None
    clouds: Receiver[PointCloud] | None = None
    odometry: Receiver[Odometry] | None = None  # how the robot moved between cloud and image


@dataclass(frozen=True)
class Outputs:
    """The same objects with masks, points, and the centres that these tell."""

    detections: Sender[ObjectDetections]


class ObjectMasks(Operator[Inputs, Outputs]):
    """Find which points in the box of an object are its own: those of the dominant near piece, off floor and walls.

    A mask that a network gave stays, without what its points show to be farther away.
    Otherwise the mask is that of the points; where there are none it is the whole box, and the centre is unknown.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: ObjectMasksConfig) -> None:
        self._config = config
        self._rays = PixelRays()

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        if inputs.depth is None and inputs.clouds is None:
            raise OperatorError("object_masks needs one of depth and clouds")
        apart_ns = round(self._config.max_apart_s * 1e9)
        async for detections, depth, cloud, odometry in anchored(
            inputs.detections,
            nearest(inputs.depth, apart_ns, optional=True),
            nearest(inputs.clouds, apart_ns, optional=True),
            window(inputs.odometry, apart_ns, apart_ns, cover=False, optional=True),
        ):
            if depth is None and cloud is None:
                warn(f"objects of {detections.frame} without depth within {apart_ns / 1e6:g} ms")
            found = await offload(self.with_masks, detections, depth, cloud, odometry or ())
            await outputs.detections.send(found)

    def with_masks(
        self,
        detections: ObjectDetections,
        depth: CameraFrame | None = None,
        cloud: PointCloud | None = None,
        odometry: Sequence[Odometry] = (),
    ) -> ObjectDetections:
        """Return objects with masks, points and centres.

        Raises:
            OperatorError: If the camera is not calibrated, or depth is of other pixels.
        """
        find: Callable[[int], Segment | None] = lambda _: None  # noqa: E731
        if depth is not None:
            find = self._in_depth(detections, depth)
        elif cloud is not None:
            find = self._in_cloud(detections, cloud, odometry)
        segments = [find(row) or unsegmented(detections, row) for row in range(len(detections))]
        centers = [center_of(segment.points) for segment in segments]
        for segment in segments:
            if not len(segment.points):
                warn("objects whose points were not found")
        most = self._config.max_points
        known = detections.camera or (depth.camera if depth is not None else None)
        return replace(
            detections,
            camera=known,
            masks=tuple(segment.mask for segment in segments),
            mask_sources=tuple(segment.source for segment in segments),
            points_m=tuple(sampled(segment.points, most) for segment in segments),
            centers_m=np.array([c for c, _ in centers], np.float32).reshape(-1, 3),
            center_sigmas_m=np.array([s for _, s in centers], np.float32),
        )

    def _in_depth(self, detections: ObjectDetections, depth: CameraFrame) -> Callable[[int], Segment | None]:  # fmt: skip
        camera = _camera(detections, depth.camera)
        size = (detections.height_px, detections.width_px)
        if depth.image.shape[:2] != size or (camera.height_px, camera.width_px) != size:
            raise OperatorError(
                f"depth of {depth.frame} is not of the pixels of {detections.frame}; put depth_registration"
                " before object_masks"
            )
        config = self._config
        depth_m = depth_m_of(depth, least_m=config.min_depth_m, most_m=config.max_depth_m)
        rays = self._rays.of(camera)
        return lambda row: depth_segment(detections, row, depth_m, rays)

    def _in_cloud(
        self, detections: ObjectDetections, cloud: PointCloud, odometry: Sequence[Odometry]
    ) -> Callable[[int], Segment | None]:
        camera = _camera(detections, None)
        T_image_cloud = moved(odometry, detections.stamp_ns, cloud.stamp_ns)
        T_camera_base = detections.T_base_sensor.inverse() @ T_image_cloud
        seen = seen_points(cloud.points.astype(np.float64), T_camera_base, camera)
        return lambda row: lidar_segment(detections, row, seen)


def _camera(detections: ObjectDetections, other: CameraCalibration | None) -> CameraCalibration:
    """Return the calibration of the camera; that of the depth, if the detector did not pass it on."""
    camera = detections.camera or other
    if camera is None:
        raise OperatorError(
            f"{detections.frame}: object_masks needs its calibration; name a rig file"
        )
    return camera
