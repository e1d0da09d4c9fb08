"""Keypoints with the 3D points that a depth camera saw there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from mapstream.operators.images.depth import depth_m_of
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.operators.tracking.rays import rays
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures
from mapstream.streams.sync import anchored, nearest

_REACH_PX = 1  # around a keypoint, where depth must be smooth


class KeypointDepthConfig(OperatorConfig):
    """Options of `keypoint_depth`."""

    max_apart_s: PositiveFloat = 0.02
    """So far depth may be from the image."""
    min_depth_m: NonNegativeFloat = 0.3
    max_depth_m: PositiveFloat = 8.0
    """Farther depth is not used: the keypoint stays a ray."""
    sigma_at_1_m: PositiveFloat = 0.003
    """Uncertainty of a depth of 1 m; it grows with the square of the depth, as disparity has it."""
    max_step: PositiveFloat = 0.05
    """By which share of itself depth may change around a keypoint; at an edge it is of one side or the other."""


@dataclass(frozen=True)
class Inputs:
    """Keypoints, and depth in the same camera (see `depth_registration`)."""

    features: Receiver[ImageFeatures]
    depth: Receiver[CameraFrame]


@dataclass(frozen=True)
class Outputs:
    """The same keypoints."""

    features: Sender[ImageFeatures]


class KeypointDepth(Operator[Inputs, Outputs]):
    """Give keypoints their 3D points where depth is known and smooth; the others stay rays."""

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: KeypointDepthConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        apart_ns = round(self._config.max_apart_s * 1e9)
        async for features, depth in anchored(
            inputs.features, nearest(inputs.depth, apart_ns, optional=True)
        ):
            if depth is None:
                warn(f"images of {features.frame} without depth within {apart_ns / 1e6:g} ms")
                await outputs.features.send(features)
                continue
            await outputs.features.send(await offload(self.with_depth, features, depth))

    def with_depth(self, features: ImageFeatures, depth: CameraFrame) -> ImageFeatures:
        """Return the keypoints with points and their uncertainty.

        Raises:
            OperatorError: If the depth is of another camera.
        """
        if features.camera is None:
            warn(f"keypoints of {features.frame} without a camera model get no depth")
            return features
        if not _is_registered(depth, features.camera):
            raise OperatorError(
                f"depth of {depth.frame} is not registered to {features.frame}; put depth_registration"
                " before keypoint_depth"
            )
        z = self._depth_m(features.keypoints_px, depth)
        directions = rays(features.camera, features.keypoints_px)
        points = directions * (z / directions[:, 2])[:, None]
        sigmas = self._config.sigma_at_1_m * z**2 / directions[:, 2]
        return replace(
            features,
            points_m=points.astype(np.float32),
            point_sigmas_m=np.nan_to_num(sigmas, nan=1.0).astype(np.float32),
        )

    def _depth_m(self, px: Float32Array, depth: CameraFrame) -> FloatArray:
        """Return the depth (N,) at pixels; NaN where there is none that can be trusted.

        Raises:
            OperatorError: If it is no depth image.
        """
        config = self._config
        depth_m = depth_m_of(depth, least_m=config.min_depth_m, most_m=config.max_depth_m)
        height, width = depth_m.shape
        steps = np.arange(-_REACH_PX, _REACH_PX + 1)
        column, row = np.round(px).astype(np.int64).T
        inside = (column >= _REACH_PX) & (column < width - _REACH_PX)
        inside &= (row >= _REACH_PX) & (row < height - _REACH_PX)
        columns = np.clip(column, _REACH_PX, width - 1 - _REACH_PX)[:, None, None] + steps
        rows = np.clip(row, _REACH_PX, height - 1 - _REACH_PX)[:, None, None] + steps[:, None]
        around = depth_m[rows, columns].astype(np.float64).reshape(len(px), -1)
        usable = np.isfinite(around)
        nearest_m = np.where(usable, around, np.inf).min(axis=1, initial=np.inf)
        farthest_m = np.where(usable, around, 0).max(axis=1, initial=0)
        counts = np.maximum(usable.sum(axis=1), 1)
        mean_m = np.where(usable, around, 0).sum(axis=1) / counts
        good = inside & (usable.mean(axis=1) > 0.5)
        good &= farthest_m - nearest_m < config.max_step * mean_m
        return np.where(good, mean_m, np.nan)


def _is_registered(depth: CameraFrame, camera: CameraCalibration) -> bool:
    """Return whether pixels of depth are pixels of a camera, as far as both say."""
    other = camera if depth.camera is None else depth.camera
    has_size = depth.image.shape[:2] == (camera.height_px, camera.width_px)
    return has_size and np.allclose(other.camera_matrix, camera.camera_matrix)
