"""The tracks of a left image in the right image of its pair, near their epipolar lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import PositiveFloat

from mapstream.operators.images.calibrated import fitted
from mapstream.operators.operator import OperatorConfig
from mapstream.operators.tracking.epipolar import off_arc
from mapstream.operators.tracking.rays import rays
from mapstream.streams.arrays import BoolArray, Float32Array
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame


class StereoOptions(OperatorConfig):
    """How a track is found in the right image."""

    max_epipolar_px: PositiveFloat = 2.0
    """So far from its epipolar line a match may be."""
    max_pair_apart_s: PositiveFloat = 0.005
    """Between the stamps of two images that are a pair."""


@dataclass(frozen=True, slots=True)
class StereoPair:
    """Two calibrated cameras that see the same."""

    left: CameraCalibration
    right: CameraCalibration
    T_right_left: SE3

    @classmethod
    def of(cls, left: CameraFrame, right: CameraFrame) -> StereoPair | None:
        """Return the pair that took two images; None if either lacks a calibration, or they do not sit apart."""
        T_right_left = right.T_base_sensor.inverse() @ left.T_base_sensor
        if left.camera is None or right.camera is None or not T_right_left.t.any():
            return None
        return cls(left.camera, right.camera, T_right_left)

    def at_infinity(self, left_px: Float32Array) -> Float32Array:
        """Return where points (N, 2) of the left image would be in the right one if they were infinitely far."""
        far, is_seen = project(self.right, rays(self.left, left_px) @ self.T_right_left.R.T)
        return np.where(is_seen[:, None], far, left_px).astype(np.float32)

    def agrees(
        self, left_px: Float32Array, right_px: Float32Array, max_epipolar_px: float
    ) -> BoolArray:
        """Return which matches (N,) lie on their epipolar lines, and in front of both cameras."""
        start = rays(self.left, left_px) @ self.T_right_left.R.T
        goal = self.T_right_left.t / np.linalg.norm(self.T_right_left.t)
        limit_rad = max_epipolar_px / float(self.right.focal_px.mean())
        missed = off_arc(start, rays(self.right, right_px), goal[None], limit_rad)[0]
        agreeing: BoolArray = np.isfinite(missed)
        return agreeing


def fitted_pair(left: CameraFrame, right: CameraFrame) -> CameraFrame | str:
    """Return the right image of a pair, or why it has to go: it is not of its calibration's size, or the left one's."""
    if left.image.shape[:2] == right.image.shape[:2]:
        return fitted(right, "drop")
    return f"images of {right.frame} that are not as large as those of {left.frame}"
