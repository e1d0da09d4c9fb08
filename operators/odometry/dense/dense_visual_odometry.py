"""Odometry from whole images of colour and depth, at the frame rate of a camera.

Source: Kerl, Sturm, Cremers: Dense Visual SLAM for RGB-D Cameras, IROS 2013, section III.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from pydantic import Field, PositiveFloat

from mapstream.operators.features.gray import gray
from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.depth import depth_m_of
from mapstream.operators.odometry.dense.tracker import DenseTracker, DenseTrackerConfig, View
from mapstream.operators.odometry.dense.views import Level, levels_of
from mapstream.operators.operator import Operator, Placement, offload, warn
from mapstream.streams.arrays import FloatArray
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import EstimationError, OperatorError
from mapstream.streams.geometry import SE3, straightened
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.sync import anchored, nearest


class DenseVisualOdometryConfig(DenseTrackerConfig):
    """Options of `dense_visual_odometry`."""

    max_apart_s: PositiveFloat = 0.02
    """So far depth may be from the image."""
    width_px: int = Field(default=320, ge=80)
    """Images are halved until they are no wider; larger ones cost more and tell little more."""
    min_depth_m: PositiveFloat = 0.3
    max_depth_m: PositiveFloat = 6.0


@dataclass(frozen=True)
class Inputs:
    """Colour or gray images, and depth in the same camera (see `depth_registration`)."""

    frames: Receiver[CameraFrame]
    depth: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    """One per image with depth; the odom frame is the base at the first of them."""

    odometry: Sender[Odometry]


class DenseVisualOdometry(Operator[Inputs, Outputs]):
    """Find the motion of a camera that makes colours and depths of whole images agree.

    Each image is compared with a keyframe, which is replaced where it tells too little. An image that does not
    fit is compared with the one before it as well; if that fails too, it is lost: it stays where the last one
    was, and says so.
    """

    placement: ClassVar[Placement] = "process"  # numpy on small matrices holds the GIL

    def __init__(self, config: DenseVisualOdometryConfig) -> None:
        self._config = config
        self._tracker: DenseTracker | None = None  # from the first image on
        self._last_ns = 0  # stamp of the last image

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        apart_ns = round(self._config.max_apart_s * 1e9)
        pairs = anchored(inputs.frames, nearest(inputs.depth, apart_ns))
        async for frame, depth in pairs:
            odometry = await offload(self.track, frame, depth)
            if odometry is not None:
                await outputs.odometry.send(odometry)
        if pairs.stats.unmatched:
            warn(pairs.explain())

    def track(self, frame: CameraFrame, depth: CameraFrame) -> Odometry | None:
        """Return the odometry at an image; None if it comes out of order.

        Raises:
            OperatorError: If a calibration is missing or has a distortion, or depth is not as large as the image.
        """
        levels, T_base_camera = self._levels(frame, depth), frame.T_base_sensor
        stamp_ns, last_ns = frame.stamp_ns, self._last_ns
        if self._tracker is None:
            self._tracker = DenseTracker(View(stamp_ns, levels, T_base_camera.matrix), self._config)
            self._last_ns = stamp_ns
            return self._odometry(frame, self._tracker, None)
        if stamp_ns <= last_ns:
            warn("images whose stamp does not increase were left out")
            return None
        self._last_ns = stamp_ns
        try:
            of_camera = self._tracker.follow(stamp_ns, levels)
        except EstimationError as error:
            warn(f"images without a pose: {error}")
            covariance = self._tracker.lose(stamp_ns, levels, (stamp_ns - last_ns) / 1e9)
            return self._odometry(frame, self._tracker, covariance, is_lost=True)
        adjoint = T_base_camera.adjoint()
        return self._odometry(frame, self._tracker, adjoint @ of_camera @ adjoint.T)

    def _levels(self, frame: CameraFrame, depth: CameraFrame) -> list[Level]:
        camera, config = require_camera(frame), self._config
        if (camera.model, camera.distortion) != ("pinhole", "none"):
            raise OperatorError(
                f"images of {frame.frame} are of a {camera.model} camera with distortion "
                f"{camera.distortion}; put undistort before dense_visual_odometry"
            )
        if depth.image.shape != frame.image.shape[:2]:
            raise OperatorError(
                f"depth of {depth.frame} is {depth.image.shape}, images of {frame.frame} are "
                f"{frame.image.shape[:2]}; put depth_registration before dense_visual_odometry"
            )
        depth_m = depth_m_of(depth, least_m=config.min_depth_m, most_m=config.max_depth_m)
        return levels_of(gray(frame), depth_m, camera, config.width_px)

    def _odometry(
        self,
        frame: CameraFrame,
        tracker: DenseTracker,
        covariance: FloatArray | None,
        *,
        is_lost: bool = False,
    ) -> Odometry:
        T_odom_base = SE3(tracker.T_odom_camera) @ frame.T_base_sensor.inverse()
        return Odometry(
            stamp_ns=frame.stamp_ns,
            T_odom_base=SE3(straightened(T_odom_base.matrix)),
            covariance=covariance,
            is_lost=is_lost,
        )
