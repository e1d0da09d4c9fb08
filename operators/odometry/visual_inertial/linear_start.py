"""A first guess of a motion's start, from what is linear in it: velocity and gravity.

With the rotations known, points, first velocity and gravity are linear in the keypoints. The points are
eliminated; gravity has a known length and moves on a sphere.
Source: Dong-Si and Mourikis, Estimator Initialization in Vision-aided Inertial Navigation, IROS 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.odometry.visual.sightings import Sightings, grouped
from mapstream.operators.odometry.visual_inertial.integration import Integration
from mapstream.streams.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MotionStart:
    """What is looked for, in the axes of the IMU at the first image."""

    gyro_bias: FloatArray  # (3,)
    accel_bias: FloatArray  # (3,)
    velocity: FloatArray  # (3,) [m/s]
    down: FloatArray  # (3,) unit

    @property
    def sides(self) -> FloatArray:
        """Return two directions (3, 2) in which `down` can move."""
        return np.asarray(np.linalg.svd(self.down[None])[2][1:].T)

    def moved(self, step: FloatArray) -> MotionStart:
        down = self.down + self.sides @ step[9:]
        return MotionStart(
            self.gyro_bias + step[:3],
            self.accel_bias + step[3:6],
            self.velocity + step[6:9],
            down / np.linalg.norm(down),
        )


def linear_start(
    sightings: Sightings, integration: Integration, gyro_bias: FloatArray, gravity_mps2: float
) -> MotionStart:
    """Return velocity and gravity without an accelerometer's bias, from what is linear in them."""
    down = -integration.mean_force / np.linalg.norm(integration.mean_force)
    start = MotionStart(gyro_bias, np.zeros(3), np.zeros(3), down)
    guess = integration.integrated(gyro_bias[None], np.zeros((1, 3)))
    group = grouped(sightings, np.arange(len(guess.times_s)), guess.R[0], guess.p[0])
    rows, centres = group.views.rows, group.views.centres
    times = (
        guess.times_s[np.maximum(group.images, 0)][..., None, None]
        * (group.images >= 0)[..., None, None]
    )
    by_speed = np.concatenate([times * np.eye(3), times**2 / 2 * np.eye(3)], axis=-1)
    squares = np.swapaxes(rows, -1, -2) @ rows  # (F, M, 3, 3)
    C = squares.sum(1)
    scale = np.trace(C, axis1=1, axis2=2)[:, None, None]
    C = np.linalg.inv(C + 1e-9 * scale * np.eye(3))
    cross = (squares @ by_speed).sum(1)  # (F, 3, 6)
    known = (squares @ centres[..., None]).sum(1)  # (F, 3, 1)
    weight = (1 / scale)[:, :, 0]
    A = (np.swapaxes(by_speed, -1, -2) @ squares @ by_speed).sum(1)
    A = ((A - np.swapaxes(cross, 1, 2) @ C @ cross) * weight[..., None]).sum(0)
    b = (np.swapaxes(by_speed, -1, -2) @ squares @ centres[..., None]).sum(1)
    b = -((b - np.swapaxes(cross, 1, 2) @ C @ known) * weight[..., None]).sum(0)[:, 0]
    for _ in range(6):
        free = np.zeros((6, 5))
        free[:3, :3], free[3:, 3:] = np.eye(3), gravity_mps2 * start.sides
        fixed = np.append(np.zeros(3), gravity_mps2 * start.down)
        N = free.T @ A @ free
        x = np.linalg.solve(N + 1e-12 * np.trace(N) * np.eye(5), free.T @ (b - A @ fixed))
        step = np.concatenate([np.zeros(6), x[:3] - start.velocity, np.clip(x[3:], -0.5, 0.5)])
        start = start.moved(step)
    return start
