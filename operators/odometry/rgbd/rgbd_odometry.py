"""Odometry from colour and depth at a low frame rate, of things without texture."""

from __future__ import annotations

import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.features.gray import gray
from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.depth import PixelRays, depth_m_of
from mapstream.operators.odometry.rgbd.paired import PairedOdometry, require_registered
from mapstream.operators.odometry.rgbd.shape import Shape, shape_of
from mapstream.operators.odometry.rgbd.shape_fit import ShapeFit, fit_shape
from mapstream.operators.odometry.uncertainty import chain, unmeasured
from mapstream.operators.operator import OperatorConfig, warn
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, invert, so3_log, straightened
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import CameraFrame

_RADIAN_M = 0.5  # a keyframe turned by a radian is as far as one half a metre away


class RgbdOdometryConfig(OperatorConfig):
    """Options of `rgbd_odometry`."""

    max_apart_s: PositiveFloat = 0.02
    """So far depth may be from the image."""
    min_depth_m: PositiveFloat = 0.3
    max_depth_m: PositiveFloat = 3.0
    """Farther depth is too noisy to tell the shape."""
    num_keyframes: int = Field(default=60, ge=1)
    """So many are remembered."""
    num_compared: int = Field(default=8, ge=1)
    """With so many of them, those seen from the nearest places, an image is compared."""
    keyframe_distance_m: PositiveFloat = 0.05
    keyframe_angle_rad: PositiveFloat = 0.1
    min_matched: float = Field(default=0.5, gt=0, le=1)
    """With a smaller share of its surface on that of the keyframes an image is lost."""


class RgbdOdometry(PairedOdometry):
    """Find the pose of a camera by the planes and the edges it sees.

    Needs no texture and no high frame rate: the camera may move by 0.2 m from image to image. Surfaces count by
    the ways they face, so that a large floor does not outweigh a small box on it; edges fix what planes leave open.
    Each image is compared with keyframes from the nearest places, so that the way round a thing closes. An image
    that fits none of them is lost: it stays where the last one was, and says so.
    """

    def __init__(self, config: RgbdOdometryConfig) -> None:
        super().__init__(config.max_apart_s)
        self._config = config
        self._keyframes: list[tuple[FloatArray, Shape]] = []  # T_odom_camera (4, 4), oldest first
        self._T: FloatArray = np.eye(4)  # T_odom_camera of the last image
        self._covariance: FloatArray = np.zeros(
            (6, 6)
        )  # of the last pose of the base, perturbed on the right
        self._last_ns: int | None = None
        self._rays = PixelRays()

    def track(self, frame: CameraFrame, depth: CameraFrame) -> Odometry | None:
        """Return the odometry at an image; None if it comes out of order.

        Raises:
            OperatorError: If a calibration is missing, or depth is not as large as the image.
        """
        if self._last_ns is not None and frame.stamp_ns <= self._last_ns:
            warn("images whose stamp does not increase were left out")
            return None
        shape = self._shape(frame, depth)
        T_camera_base = frame.T_base_sensor.inverse()
        if self._last_ns is None:
            self._last_ns, self._T = frame.stamp_ns, frame.T_base_sensor.matrix
            self._keyframes.append((self._T, shape))
            return self._odometry(T_camera_base, None)
        duration_s = (frame.stamp_ns - self._last_ns) / 1e9
        self._last_ns = frame.stamp_ns
        try:
            fit = self._fit(shape)
        except EstimationError as error:
            warn(f"images without a pose: {error}")
            self._covariance = unmeasured(duration_s)
            return self._odometry(T_camera_base, self._covariance, is_lost=True)
        covariance = self._follow(fit, T_camera_base)
        self._remember(shape)
        return self._odometry(T_camera_base, covariance)

    def _follow(self, fit: ShapeFit, T_camera_base: SE3) -> FloatArray:
        """Take a pose over; return the covariance (6, 6) of the step to it."""
        T_base_camera = T_camera_base.inverse()
        step = T_base_camera @ SE3(straightened(invert(self._T) @ fit.T_world_camera))
        adjoint = T_base_camera.adjoint()
        of_pose = adjoint @ fit.covariance @ adjoint.T
        of_step = chain(self._covariance, step @ T_camera_base, of_pose)
        self._T, self._covariance = fit.T_world_camera, of_pose
        return of_step

    def _shape(self, frame: CameraFrame, depth: CameraFrame) -> Shape:
        camera, config = require_camera(frame), self._config
        require_registered(frame, depth, "rgbd_odometry")
        depth_m = depth_m_of(depth, least_m=config.min_depth_m, most_m=config.max_depth_m)
        return shape_of(gray(frame), depth_m, self._rays.of(camera))

    def _fit(self, shape: Shape) -> ShapeFit:
        """Return the pose of an image against the keyframes from the nearest places.

        Raises:
            EstimationError: If there is no such pose.
        """
        order = np.argsort([_apart(T, self._T) for T, _ in self._keyframes], kind="stable")
        near = [self._keyframes[i] for i in order[: self._config.num_compared]]
        fit = fit_shape(shape, near, self._T)
        if fit.matched < self._config.min_matched:
            raise EstimationError("too little of the surface fits that of the keyframes")
        return fit

    def _remember(self, shape: Shape) -> None:
        """Take the image as keyframe if no keyframe is near."""
        distance_m, angle_rad = self._config.keyframe_distance_m, self._config.keyframe_angle_rad
        for T, _ in self._keyframes:
            moved = invert(T) @ self._T
            angle = np.linalg.norm(so3_log(moved[:3, :3]))
            if np.linalg.norm(moved[:3, 3]) < distance_m and angle < angle_rad:
                return
        self._keyframes.append((self._T, shape))
        del self._keyframes[: -self._config.num_keyframes]

    def _odometry(
        self, T_camera_base: SE3, covariance: FloatArray | None, *, is_lost: bool = False
    ) -> Odometry:
        return Odometry(
            stamp_ns=self._last_ns or 0,
            T_odom_base=SE3(straightened((SE3(self._T) @ T_camera_base).matrix)),
            covariance=covariance,
            is_lost=is_lost,
        )


def _apart(a: FloatArray, b: FloatArray) -> float:
    """Return how far two views are from each other [m]."""
    T = invert(a) @ b
    return float(np.linalg.norm(T[:3, 3]) + _RADIAN_M * np.linalg.norm(so3_log(T[:3, :3])))
