"""An IMU's motion over a stretch of images, for many guesses of its biases at once.

Rotations, and what forces alone would do to velocity and place, all in the axes of the IMU at the first
image; first velocity and gravity come on top and are not in them (preintegration).
Source: Forster et al., On-Manifold Preintegration for Real-Time Visual-Inertial Odometry, T-RO 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.odometry.visual_inertial.propagation import Motion
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import so3_exp


@dataclass(frozen=True, slots=True, eq=False)
class Integrated:
    """At K images, for B guesses."""

    R: FloatArray  # (B, K, 3, 3)
    p: FloatArray  # (B, K, 3) [m]
    times_s: FloatArray  # (K,) since the first image


class Integration:
    """Samples from image to image.

    Args:
        motions: K - 1 of them, each from one image to the next.
    """

    def __init__(self, motions: list[Motion]) -> None:
        middles = [motion.midway() for motion in motions]
        self._rates = np.concatenate([rates for rates, _ in middles])  # (N, 3)
        self._forces = np.concatenate([forces for _, forces in middles])
        self._steps_s = np.concatenate([motion.steps_s for motion in motions])
        counts = [len(motion.steps_s) for motion in motions]
        self.frames: IntArray = np.cumsum([0, *counts])  # (K,) which knot each image is
        self.times_s = np.append(0.0, np.cumsum(self._steps_s))[self.frames]

    @property
    def mean_force(self) -> FloatArray:
        return np.asarray(self._forces.mean(axis=0))

    def rotations(self, gyro_biases: FloatArray) -> FloatArray:
        """Return R (B, K, 3, 3) for biases (B, 3)."""
        return self._knots(gyro_biases)[:, self.frames]

    def integrated(self, gyro_biases: FloatArray, accel_biases: FloatArray) -> Integrated:
        """Return the motion for biases (B, 3) and (B, 3)."""
        R = self._knots(gyro_biases)
        dt = self._steps_s[:, None]
        half = so3_exp((self._rates - gyro_biases[:, None]) * dt / 2)
        forces = (R[:, :-1] @ half @ (self._forces - accel_biases[:, None])[..., None])[..., 0]
        gained = np.cumsum(forces * dt, axis=1)
        before = gained - forces * dt
        moved = np.cumsum(before * dt + forces * dt**2 / 2, axis=1)
        start = np.zeros((len(R), 1, 3))
        p = np.concatenate([start, moved], axis=1)[:, self.frames]
        return Integrated(R[:, self.frames], p, self.times_s)

    def _knots(self, gyro_biases: FloatArray) -> FloatArray:
        turns = so3_exp((self._rates - gyro_biases[:, None]) * self._steps_s[:, None])
        R = np.empty((len(gyro_biases), len(self._steps_s) + 1, 3, 3))
        R[:, 0] = np.eye(3)
        for k in range(len(self._steps_s)):
            R[:, k + 1] = R[:, k] @ turns[:, k]
        return R
