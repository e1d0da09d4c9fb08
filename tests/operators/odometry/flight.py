"""A camera rig and an IMU that fly through a cloud of points: exact truth, keypoints with tracks, samples."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project
from mapstream.streams.geometry import SE3, invert, so3_exp, so3_log
from mapstream.streams.messages.sensors import ImuBatch
from mapstream.streams.messages.vision import ImageFeatures, NFrame

START_NS = 1_000_000_000_000
GRAVITY = 9.81
# x of the camera is right, y down, z ahead; the base has x ahead and z up
LOOK = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def camera(name: str = "cam0") -> CameraCalibration:
    return CameraCalibration(
        frame=name,
        model="pinhole",
        width_px=640,
        height_px=480,
        focal_px=np.array([400.0, 400.0]),
        center_px=np.array([320.0, 240.0]),
        distortion_parameters=np.empty(0),
    )


@dataclass(frozen=True)
class Flight:
    """How the rig moves, and how well it measures."""

    duration_s: float = 4.0
    rest_s: float = 0.0  # at the beginning
    swing_m: float = 1.0
    turn_rad: float = 0.3
    image_hz: float = 10.0
    num_cameras: int = 1
    sigma_px: float = 0.5
    gyro_bias: tuple[float, float, float] = (0.02, -0.03, 0.01)
    accel_bias: tuple[float, float, float] = (0.05, -0.08, 0.1)
    gyro_density: float = 2e-4
    accel_density: float = 2e-3
    seed: int = 0
    T_base_imu: SE3 = field(default_factory=lambda: SE3.exp([0.1, -0.05, 0.2, 0.05, 0.02, -0.03]))

    def poses(self, times_s: FloatArray) -> FloatArray:
        """Return T_world_base (N, 4, 4)."""
        t = np.maximum(times_s - self.rest_s, 0)
        phases = np.array([1.3, 1.9, 2.3])
        place = self.swing_m * np.array([1.0, 0.8, 0.5]) * (1 - np.cos(t[:, None] * phases))
        turn = self.turn_rad * np.array([0.5, 0.6, 1.0]) * (1 - np.cos(t[:, None] * phases[::-1]))
        T = np.tile(np.eye(4), (len(t), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = so3_exp(turn), place
        return T

    def truth(self, stamps_ns: IntArray) -> FloatArray:
        """Return T_world_base (N, 4, 4) at stamps."""
        return self.poses((stamps_ns - START_NS) / 1e9)

    def imu(self) -> ImuBatch:
        h = 1e-4
        t = np.arange(0, self.duration_s + 0.1, 0.005)
        before, now, after = (
            self.poses(np.maximum(t + k * h, 0)) @ self.T_base_imu.matrix for k in (-1, 0, 1)
        )
        rate = so3_log(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]) / (2 * h)
        force = (before[:, :3, 3] - 2 * now[:, :3, 3] + after[:, :3, 3]) / h**2
        force = force + np.array([0, 0, GRAVITY])
        force = np.einsum("nji,nj->ni", now[:, :3, :3], force)
        rng = np.random.default_rng(self.seed)
        noise = rng.standard_normal((2, len(t), 3)) * np.sqrt(200.0)
        return ImuBatch(
            stamps_ns=START_NS + np.round(t * 1e9).astype(np.int64),
            gyro_radps=rate + self.gyro_bias + noise[0] * self.gyro_density,
            accel_mps2=force + self.accel_bias + noise[1] * self.accel_density,
            T_base_sensor=self.T_base_imu,
        )

    def frames(self) -> list[NFrame]:
        rng = np.random.default_rng(self.seed + 1)
        points = np.column_stack(
            [rng.uniform(4, 12, 300), rng.uniform(-6, 6, 300), rng.uniform(-4, 5, 300)]
        )
        t = np.arange(0, self.duration_s, 1 / self.image_hz)
        stamps = START_NS + np.round(t * 1e9).astype(np.int64)
        mounts = [SE3.from_rotation(LOOK, [0.1, -0.2 * k, 0.0]) for k in range(self.num_cameras)]
        frames = []
        for stamp, pose in zip(stamps.tolist(), self.poses(t), strict=True):
            seen = []
            for k, mount in enumerate(mounts):
                T_camera_world = invert(pose @ mount.matrix)
                px, valid = project(
                    camera(), points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
                )
                valid &= ((px >= 0) & (px < [640, 480])).all(axis=1)
                px = px[valid] + rng.standard_normal((int(valid.sum()), 2)) * self.sigma_px
                seen.append(
                    ImageFeatures(
                        stamp_ns=stamp,
                        kind="klt",
                        frame=f"cam{k}",
                        keypoints_px=px.astype(np.float32),
                        track_ids=np.flatnonzero(valid),
                        T_base_sensor=mount,
                        camera=camera(f"cam{k}"),
                    )
                )
            frames.append(NFrame(stamp_ns=stamp, features=tuple(seen)))
        return frames
