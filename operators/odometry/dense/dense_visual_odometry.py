"""Odometry from whole images of colour and depth, at the frame rate of a camera.

Source: Kerl, Sturm, Cremers: Dense Visual SLAM for RGB-D Cameras, IROS 2013, section III.
"""

from __future__ import annotations

from pydantic import Field, PositiveFloat

from mapstream.operators.features.gray import gray
from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.depth import depth_m_of
from mapstream.operators.odometry.dense.tracker import DenseTracker, DenseTrackerConfig, View
from mapstream.operators.odometry.dense.views import Level, levels_of
from mapstream.operators.odometry.rgbd.paired import PairedOdometry, require_registered
from mapstream.operators.operator import warn
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError, OperatorError
from mapstream.streams.geometry import SE3, straightened
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import CameraFrame


class DenseVisualOdometryConfig(DenseTrackerConfig):
    """Options of `dense_visual_odometry`."""

    max_apart_s: PositiveFloat = 0.02
    """So far depth may be from the image."""
    width_px: int = Field(default=320, ge=80)
    """Images are halved until they are no wider; larger ones cost more and tell little more."""
    min_depth_m: PositiveFloat = 0.3
    max_depth_m: PositiveFloat = 6.0


class DenseVisualOdometry(PairedOdometry):
    """Find the motion of a camera that makes colours and depths of whole images agree.

    Each image is compared with a keyframe, which is replaced where it tells too little. An image that does not
    fit is compared with the one before it as well; if that fails too, it is lost: it stays where the last one
    was, and says so.
    """

    def __init__(self, config: DenseVisualOdometryConfig) -> None:
        super().__init__(config.max_apart_s)
        self._config = config
        self._tracker: DenseTracker | None = None  # from the first image on
        self._last_ns = 0  # stamp of the last image

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
        require_registered(frame, depth, "dense_visual_odometry")
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
