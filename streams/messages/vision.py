"""What cameras see: keypoints with their descriptors and tracks, of one image or of all of one moment."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import Float32Array, IntArray, frozen, frozen_optional
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.sensors import RecordRef

NO_TRACK = -1
"""In `ImageFeatures.track_ids`: a keypoint that belongs to no track."""


def _no_descriptors() -> npt.NDArray[Any]:
    return np.empty((0, 0), np.uint8)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageFeatures:
    """Keypoints that one detector found in one image, and what is known of each.

    Keypoints of one kind with one track id are of one point, in whichever camera and image of a mission.
    A LiDAR's or a depth camera's keypoints have their 3D points as well, in the frame of their sensor.
    """

    stamp_ns: int
    kind: str  # orb, brisk, sift ...; features of different kinds never meet
    frame: str  # the sensor
    keypoints_px: Float32Array  # (N, 2) x, y; the middle of the first pixel is (0, 0)
    descriptors: npt.NDArray[Any] = field(default_factory=_no_descriptors)  # (N, D) u1 bits or f4
    scores: Float32Array | None = None  # (N,)
    scales: Float32Array | None = None  # (N,) diameter [px]
    orientations_rad: Float32Array | None = None  # (N,)
    sigmas_px: Float32Array | None = None  # (N,) standard deviations of the keypoints
    track_ids: IntArray | None = None  # (N,) NO_TRACK where there is none
    points_m: Float32Array | None = None  # (N, 3) in the sensor's frame; NaN: only a ray is known
    point_sigmas_m: Float32Array | None = None  # (N,)
    offsets_ns: IntArray | None = None  # (N,) time of each keypoint after stamp_ns
    objects: ObjectDetections | None = None  # of kind `object`: N of them, each keypoint its middle
    T_base_sensor: SE3 = field(default_factory=SE3.identity)
    camera: CameraCalibration | None = None
    record: RecordRef | None = None  # the image, where it lies

    def __post_init__(self) -> None:
        n = frozen(self, "keypoints_px", np.float32, (None, 2)).shape[0]
        if self.descriptors.size == 0:
            width = self.descriptors.shape[1] if self.descriptors.ndim == 2 else 0
            object.__setattr__(self, "descriptors", np.empty((n, width), self.descriptors.dtype))
        frozen(self, "descriptors", self.descriptors.dtype, (n, None))
        for name in ("scores", "scales", "orientations_rad", "sigmas_px", "point_sigmas_m"):
            frozen_optional(self, name, np.float32, (n,))
        frozen_optional(self, "points_m", np.float32, (n, 3))
        frozen_optional(self, "track_ids", np.int64, (n,))
        frozen_optional(self, "offsets_ns", np.int64, (n,))
        if self.objects is not None and len(self.objects) != n:
            raise ValueError(f"ImageFeatures: {n} keypoints of {len(self.objects)} objects")

    def __len__(self) -> int:
        return len(self.keypoints_px)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NFrame:
    """What all cameras of a robot and all kinds of features saw at one moment (maplab's n-frame)."""

    stamp_ns: int  # of the first camera; the others differ by less than a tolerance
    features: tuple[ImageFeatures, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GlobalDescriptor:
    """What a whole image looks like, as one vector: those of the same place have a large dot product."""

    stamp_ns: int
    kind: str  # the network; descriptors of different kinds never meet
    frame: str  # the camera
    vector: Float32Array  # (D,) of unit length

    def __post_init__(self) -> None:
        frozen(self, "vector", np.float32, (None,))
