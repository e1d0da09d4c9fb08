"""Keypoints of a LiDAR image, by any detector and any network that finds them in a camera's.

The image has no left and right end, and few rows: it goes on beyond all four, so that a keypoint is found and
described wherever it lies.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
from pydantic import Field, NonNegativeInt, PositiveInt

from mapstream.operators.features.detectors import DetectorOptions
from mapstream.operators.features.features import Features, FeaturesConfig
from mapstream.operators.features.finder import FeatureFinder
from mapstream.operators.features.gray import GrayImage
from mapstream.operators.features.rows import rows_of
from mapstream.operators.lidar.images.picture import wrapped
from mapstream.operators.networks.superpoint import SuperPoint, SuperPointConfig
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import Float32Array
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures

_REACH_PX = 40  # of descriptors: FREAK's is the largest


class FinderConfig(OperatorConfig):
    """What finds keypoints in LiDAR images."""

    detector: Literal["orb", "brisk", "freak", "sift", "xfeat", "superpoint"] = "brisk"
    """What is found becomes of kind lidar_orb and so on, which a camera's keypoints never meet."""
    corners: DetectorOptions = Field(
        default_factory=lambda: DetectorOptions(
            max_features=800, min_distance_px=3.0, fast_threshold=4
        )
    )
    """Of orb, brisk, freak and sift."""
    network: SuperPointConfig = Field(default_factory=SuperPointConfig)
    """Of superpoint, and as far as it concerns it, of xfeat."""
    pixels_per_beam: PositiveInt = 1
    """The image is made so many times higher before keypoints are looked for: beams lie farther apart than columns."""
    pixels_per_column: PositiveInt = 1
    border_px: NonNegativeInt = 3
    """So many beams at the upper and the lower end have no keypoints."""


class ImageFinder:
    """Finds keypoints in LiDAR images; it is used by one thread at a time."""

    def __init__(self, config: FinderConfig) -> None:
        self._config = config
        self._finder = _finder(config)

    def find(self, frame: CameraFrame) -> ImageFeatures:
        """Return the keypoints of an image (H, W), whose places are in its own pixels, 0 <= x < W."""
        config = self._config
        height, width = frame.image.shape
        scale = np.array([config.pixels_per_column, config.pixels_per_beam], np.float32)
        around = np.array([_REACH_PX * config.pixels_per_column, _REACH_PX], np.float32)
        found = self._finder.detect(replace(frame, image=self._continued(frame.image)))
        px: Float32Array = (found.keypoints_px - around + 0.5) / scale - 0.5
        is_inside = (px[:, 0] >= 0) & (px[:, 0] < width)  # not a second time beyond the seam
        is_inside &= (px[:, 1] >= config.border_px) & (px[:, 1] <= height - 1 - config.border_px)
        kind = f"lidar_{found.kind}"
        return rows_of(replace(found, kind=kind, keypoints_px=px), np.flatnonzero(is_inside))

    def _continued(self, image: GrayImage) -> GrayImage:
        """Return the image, larger by its scale, that goes on around all its ends."""
        config = self._config
        whole = wrapped(image, _REACH_PX)
        across, down = config.pixels_per_column, config.pixels_per_beam
        if max(across, down) > 1:
            whole = np.asarray(cv2.resize(whole, None, fx=across, fy=down), np.uint8)
        return np.pad(whole, ((_REACH_PX, _REACH_PX), (0, 0)), mode="symmetric")


def _finder(config: FinderConfig) -> FeatureFinder:
    if config.detector == "superpoint":
        return SuperPoint(config.network)
    if config.detector == "xfeat":  # SuperPoint without a file
        return SuperPoint(config.network.model_copy(update={"model": None}))
    options = config.corners.model_dump()
    return Features(FeaturesConfig(kind=config.detector, **options))
