"""What a turning, walking camera sees of W-VI's hall, and where each of its pixels goes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from mapstream.recordings.worlds.renderer import Pinhole, Renderer
from mapstream.recordings.worlds.w_vi import WViConfig, vi_hall
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project, unproject
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame, ImuBatch

PERIOD_NS = 50_000_000
CAMERA = CameraCalibration(
    frame="front",
    width_px=640,
    height_px=480,
    focal_px=np.array([400.0, 400.0]),
    center_px=np.array([319.5, 239.5]),
    distortion="none",
    distortion_parameters=np.empty(0),
)
_PINHOLE = Pinhole((400.0, 400.0), (319.5, 239.5), (640, 480))
_AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # the camera's z is the base's x
T_BASE_CAMERA = SE3.from_rotation(_AHEAD, [0.1, 0.0, 0.0])
_GYRO_BIAS = np.array([0.01, -0.02, 0.015])


@cache
def _renderer() -> Renderer:
    return Renderer(vi_hall(WViConfig(texel_m=0.02), seed=0).surfaces)


@dataclass(frozen=True, eq=False)
class HallView:
    """An image and the depth of its every pixel."""

    stamp_ns: int
    T_world_base: SE3
    image: np.ndarray
    inverse_depths: np.ndarray

    @classmethod
    def at(cls, stamp_ns: int, T_world_base: SE3, seed: int) -> HallView:
        seen = _renderer().rendering(_PINHOLE, (T_world_base @ T_BASE_CAMERA).matrix)
        noise = np.random.default_rng(seed).normal(0, 2, seen.image.shape)
        image = np.clip(seen.image + noise, 0, 255).astype(np.uint8)
        return cls(stamp_ns, T_world_base, image, seen.inverse_depths)

    def camera_frame(self) -> CameraFrame:
        return CameraFrame(
            stamp_ns=self.stamp_ns,
            image=self.image,
            encoding="mono8",
            frame="front",
            camera=CAMERA,
            T_base_sensor=T_BASE_CAMERA,
        )

    def px_in(self, other: HallView, px: np.ndarray) -> FloatArray:
        """Return where pixels (N, 2) of this view are in another one."""
        column, row = np.rint(px).astype(int).T
        rays = unproject(CAMERA, px.astype(np.float64))
        points = rays / rays[:, 2:] / self.inverse_depths[row, column][:, None]
        T_other_self = (other.T_world_base @ T_BASE_CAMERA).inverse() @ (
            self.T_world_base @ T_BASE_CAMERA
        )
        return project(CAMERA, T_other_self @ points)[0]


@cache
def walk(count: int, yaw_degps: float, speed_mps: float = 1.0) -> tuple[HallView, ...]:
    """Return views of a robot that walks and turns, 20 a second."""
    views = []
    T_world_base = SE3.from_rotation(np.eye(3), [-2.0, 0.5, 1.5])
    step_s = PERIOD_NS / 1e9
    step = SE3.exp([0, 0, np.radians(yaw_degps) * step_s, speed_mps * step_s, 0, 0])
    for i in range(count):
        views.append(HallView.at((i + 1) * PERIOD_NS, T_world_base, seed=i))
        T_world_base = T_world_base @ step
    return tuple(views)


def gyro(views: tuple[HallView, ...], yaw_degps: float) -> list[ImuBatch]:
    """Return samples at 200 Hz with noise and a bias, in batches of 10."""
    stamps = np.arange(0, views[-1].stamp_ns + PERIOD_NS, PERIOD_NS // 10)
    rng = np.random.default_rng(5)
    rates = np.array([0, 0, np.radians(yaw_degps)]) + _GYRO_BIAS
    gyro_radps = rates + rng.normal(0, 0.01, (len(stamps), 3))
    return [
        ImuBatch(
            stamps_ns=stamps[i : i + 10],
            gyro_radps=gyro_radps[i : i + 10],
            accel_mps2=np.zeros_like(gyro_radps[i : i + 10]),
        )
        for i in range(0, len(stamps), 10)
    ]
