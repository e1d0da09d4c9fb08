"""A textured wall that a camera looks at: images by warping, and where every pixel goes."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project, unproject
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame, ImuBatch

DEPTH_M = 4.0
_TEXTURE_PX_PER_M = 100.0
PERIOD_NS = 50_000_000
# the camera looks along z, x right, y down; the base is the camera of the left image
CAMERA = CameraCalibration(
    frame="left",
    width_px=320,
    height_px=240,
    focal_px=np.array([220.0, 220.0]),
    center_px=np.array([159.5, 119.5]),
    distortion="none",
    distortion_parameters=np.empty(0),
)


def texture(seed: int = 0, size: tuple[int, int] = (1500, 1500)) -> np.ndarray:
    """Return blobs of all sizes."""
    rng = np.random.default_rng(seed)
    total = np.zeros(size, np.float32)
    for cell, weight in ((4, 1.0), (9, 1.0), (25, 0.7), (80, 0.5)):
        small = rng.uniform(-1, 1, (size[0] // cell + 2, size[1] // cell + 2)).astype(np.float32)
        total += weight * cv2.resize(small, size[::-1], interpolation=cv2.INTER_CUBIC)
    scaled = (total - total.min()) / (total.max() - total.min()) * 255
    return np.asarray(scaled, np.uint8)


TEXTURE = texture()


@dataclass(frozen=True)
class View:
    """An image of the wall from a place; `T_wall_camera` has z towards the wall, which is at z = DEPTH_M."""

    T_wall_camera: SE3
    stamp_ns: int = 0
    frame: str = "left"
    T_base_sensor: SE3 = field(default_factory=SE3.identity)

    def image(self, pattern: np.ndarray = TEXTURE) -> np.ndarray:
        R = self.T_wall_camera.R.T
        t = R @ (np.array([0, 0, DEPTH_M]) - self.T_wall_camera.t)
        K_image = CAMERA.camera_matrix
        scale, middle = 1 / _TEXTURE_PX_PER_M, np.array(pattern.shape[::-1]) / 2
        to_m = np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1]])
        H = K_image @ np.column_stack([R[:, 0], R[:, 1], t]) @ to_m
        size = (CAMERA.width_px, CAMERA.height_px)
        return np.asarray(cv2.warpPerspective(pattern, H, size), np.uint8)

    def camera_frame(self) -> CameraFrame:
        return CameraFrame(
            stamp_ns=self.stamp_ns,
            image=self.image(),
            encoding="mono8",
            frame=self.frame,
            camera=CAMERA,
            T_base_sensor=self.T_base_sensor,
        )

    def px_in(self, other: View, px: np.ndarray) -> FloatArray:
        """Return where pixels (N, 2) of this view are in another one; exact."""
        rays = unproject(CAMERA, px.astype(np.float64)) @ self.T_wall_camera.R.T
        depths = (DEPTH_M - self.T_wall_camera.t[2]) / rays[:, 2]
        points = self.T_wall_camera.t + depths[:, None] * rays
        return project(CAMERA, other.T_wall_camera.inverse() @ points)[0]


def drive(
    count: int, rate_radps: tuple[float, float, float], speed_mps: tuple[float, float, float]
) -> list[View]:
    """Return views of a camera that turns and moves steadily, 20 a second."""
    step_s = PERIOD_NS / 1e9
    views = []
    for i in range(count):
        rotation = SE3.exp([*(np.array(rate_radps) * i * step_s), 0, 0, 0])
        T_wall_camera = SE3.from_rotation(rotation.R, np.array(speed_mps) * i * step_s)
        views.append(View(T_wall_camera, (i + 1) * PERIOD_NS))
    return views


def gyro(views: list[View], rate_radps: tuple[float, float, float]) -> list[ImuBatch]:
    """Return samples at 200 Hz, in batches of 10, of a steadily turning camera."""
    first, last = views[0].stamp_ns - PERIOD_NS, views[-1].stamp_ns + PERIOD_NS
    stamps = np.arange(first, last, PERIOD_NS // 10)
    return [
        ImuBatch(
            stamps_ns=stamps[i : i + 10],
            gyro_radps=np.tile(rate_radps, (len(stamps[i : i + 10]), 1)),
            accel_mps2=np.zeros((len(stamps[i : i + 10]), 3)),
        )
        for i in range(0, len(stamps), 10)
    ]
