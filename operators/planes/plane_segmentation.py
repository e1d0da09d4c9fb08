"""Planes in depth images, as an operator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.depth import depth_m_of
from mapstream.operators.images.pinhole_maps import calibration_key
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, pipeline
from mapstream.operators.period import Period
from mapstream.operators.planes.depth_planes import SegmentationLimits, depth_planes
from mapstream.operators.planes.image_planes import ImagePlanes
from mapstream.operators.planes.local_planes import DepthGrid
from mapstream.operators.planes.plane_axes import plane_covariance, pose_on
from mapstream.operators.planes.regions import Labels
from mapstream.recordings.maps.hulls import convex_hull
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import unproject
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.messages.planes import PlaneSegments
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.structured_light import depth_sigma_m


class PlaneSegmentationConfig(OperatorConfig):
    """Options of `plane_segmentation`."""

    period_s: NonNegativeFloat = 0.0
    """The first image in each stretch of so long is looked at; 0: all are."""
    min_pixels: PositiveInt = 10_000
    """A smaller plane is none; for 640 x 480 px."""
    max_angle_deg: PositiveFloat = 2.0
    """Between the normals of neighbouring pixels of one plane."""
    max_distance_m: PositiveFloat = 0.02
    """Of a pixel from the plane of its neighbour."""
    window_px: PositiveInt = 20
    """Side of the window whose pixels tell the normal of the one amid them."""
    min_depth_m: NonNegativeFloat = 0.3
    max_depth_m: PositiveFloat = 5.0
    noise: PositiveFloat = 1.0
    """Of depths, times that of structured light, which grows with the square of the depth."""
    sigma_rad: NonNegativeFloat = Field(
        default=0.003, description="of a normal, beyond what the noise of its pixels makes of it"
    )
    sigma_m: NonNegativeFloat = Field(default=0.003, description="the same of a plane's place")


@dataclass(frozen=True)
class Inputs:
    """Depth images with their calibration."""

    frames: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    """The planes of every image, the largest first; and which pixels are on them, where somebody asks."""

    planes: Sender[PlaneSegments]
    labels: Sender[CameraFrame]  # mono8: 0 is no plane, 1 the first one


class PlaneSegmentation(Operator[Inputs, Outputs]):
    """Find planes by organised connected components, and say how sure each is."""

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: PlaneSegmentationConfig) -> None:
        self._config = config
        self._limits = SegmentationLimits(
            angle_rad=float(np.deg2rad(config.max_angle_deg)),
            distance_m=config.max_distance_m,
            window_px=config.window_px,
            min_pixels=config.min_pixels,
        )
        self._period = Period(config.period_s)
        self._rays: tuple[object, Float32Array] | None = None

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        async def send(found: tuple[PlaneSegments, CameraFrame]) -> None:
            planes, labels = found
            await outputs.planes.send(planes)
            await outputs.labels.send(labels)

        if not self._config.period_s:
            await pipeline(self.segment, inputs.frames, send)
            return
        async for frame in inputs.frames:
            if self._period.begins(frame.stamp_ns):
                await send(await offload(self.segment, frame))
            else:
                outputs.planes.advance(frame.stamp_ns)

    def segment(self, frame: CameraFrame) -> tuple[PlaneSegments, CameraFrame]:
        """Return the planes of a depth image, and an image of their numbers.

        Raises:
            OperatorError: If it is no depth image, or its camera has no calibration.
        """
        grid = self._grid(frame)
        planes, labels = depth_planes(grid, self._limits)
        rows = [self._segment(grid, planes, labels, row) for row in range(len(planes))]
        T_base_camera = frame.T_base_sensor.matrix
        segments = PlaneSegments(
            stamp_ns=frame.stamp_ns,
            T_base_plane=np.array([T_base_camera @ pose for pose, _, _ in rows]).reshape(-1, 4, 4),
            covariances=np.array([covariance for _, covariance, _ in rows]).reshape(-1, 6, 6),
            hulls_m=tuple(hull for _, _, hull in rows),
            num_points=planes.num_pixels,
            rmse_m=planes.rmse_m,
            frame=frame.frame,
            T_base_sensor=frame.T_base_sensor,
        )
        image = CameraFrame(
            stamp_ns=frame.stamp_ns,
            image=np.minimum(labels, 255).astype(np.uint8),
            encoding="mono8",
            frame=frame.frame,
            T_base_sensor=frame.T_base_sensor,
            camera=frame.camera,
        )
        return segments, image

    def _grid(self, frame: CameraFrame) -> DepthGrid:
        camera, config = require_camera(frame), self._config
        if self._rays is None or self._rays[0] != calibration_key(camera):
            self._rays = calibration_key(camera), _rays_of(camera)
        depth_m = depth_m_of(frame, least_m=config.min_depth_m, most_m=config.max_depth_m)
        inverse = np.nan_to_num(1 / depth_m).astype(np.float32, copy=False)
        sigma_m = config.noise * depth_sigma_m(depth_m.astype(np.float64))
        return DepthGrid(inverse, (sigma_m * inverse**2).astype(np.float32), *self._rays[1])

    def _segment(
        self, grid: DepthGrid, planes: ImagePlanes, labels: Labels, row: int
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the pose on a plane in the camera's frame, its covariance, and its hull."""
        q, ray = planes.q[row], planes.mean_rays[row]
        pose = pose_on(planes.normals[row], ray / (q @ ray))
        covariance = plane_covariance(pose, planes.information[row])
        covariance[[0, 1, 5], [0, 1, 5]] += np.square(
            [self._config.sigma_rad, self._config.sigma_rad, self._config.sigma_m]
        )
        at = _row_ends(labels == row + 1)
        rays = np.column_stack([grid.x[at], grid.y[at], np.ones(len(at[0]))])
        points = rays / (rays @ q)[:, None] - pose[:3, 3]
        return pose, covariance, convex_hull(points @ pose[:3, :2])


def _row_ends(mask: BoolArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the first and the last pixel in each row: no others are on the convex hull."""
    rows = np.flatnonzero(mask.any(axis=1))
    inside = mask[rows]
    first = inside.argmax(axis=1)
    last = mask.shape[1] - 1 - inside[:, ::-1].argmax(axis=1)
    return np.concatenate([rows, rows]), np.concatenate([first, last])


def _rays_of(camera: CameraCalibration) -> Float32Array:
    """Return x and y (2, H, W) of the rays of all pixels, whose z is 1."""
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = unproject(camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64))
    flat = (rays[:, :2] / rays[:, 2:]).T.astype(np.float32)
    return flat.reshape(2, camera.height_px, camera.width_px)
