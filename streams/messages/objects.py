"""Objects that detectors find in images."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import (
    BoolArray,
    Float32Array,
    FloatArray,
    IntArray,
    frozen,
    frozen_optional,
    read_only,
)
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import RecordRef

MASK_SOURCES = ("model", "lidar", "depth", "box")
"""Where a mask comes from: a network, points of a LiDAR or depth camera in the box, or the whole box."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectDetections:
    """The objects that one detector found in one image, and what later stages know of each.

    A stage passes on what it was given and adds its own: masks, points, descriptors, tracks.
    Whatever detects objects elsewhere can say it in this form; only the first seven fields are required.
    Pixels are counted as for keypoints: the middle of the first one is (0, 0), it reaches from -0.5 to 0.5.
    """

    stamp_ns: int
    frame: str  # the camera
    width_px: int  # of the image
    height_px: int
    boxes_px: Float32Array  # (N, 4) x_min, y_min, x_max, y_max
    labels: tuple[str, ...]  # N semantic classes: cup, chair ...
    scores: Float32Array  # (N,) 0 to 1
    masks: tuple[BoolArray, ...] = ()  # N of (h, w), over the pixels of `window`; or none at all
    mask_sources: tuple[str, ...] = ()  # N of MASK_SOURCES, where there are masks
    points_m: tuple[Float32Array, ...] = ()  # N of (K, 3): some that lie on it, in the camera frame
    centers_m: Float32Array | None = None  # (N, 3) in the camera frame; NaN: unknown
    center_sigmas_m: Float32Array | None = None  # (N,) along each axis
    quats_camera_object_xyzw: FloatArray | None = None  # (N, 4); NaN: no orientation is known
    extents_m: Float32Array | None = None  # (N, 3) along its axes, about its centre; NaN: unknown
    texts: tuple[str, ...] = ()  # N: what is written on it, or its tag; "": nothing. An identity
    descriptors: Float32Array | None = None  # (N, D) of unit length, NaN where there is none
    descriptor_kind: str = ""  # the network; descriptors of different kinds never meet
    track_ids: IntArray | None = None  # (N,) one object, while it is followed; NO_TRACK: none
    T_base_sensor: SE3 = field(default_factory=SE3.identity)
    camera: CameraCalibration | None = None
    record: RecordRef | None = None  # the image, where it lies

    def __post_init__(self) -> None:
        n = frozen(self, "boxes_px", np.float32, (None, 4)).shape[0]
        frozen(self, "scores", np.float32, (n,))
        for name, shape in (
            ("centers_m", (n, 3)),
            ("center_sigmas_m", (n,)),
            ("extents_m", (n, 3)),
        ):
            frozen_optional(self, name, np.float32, shape)
        frozen_optional(self, "quats_camera_object_xyzw", np.float64, (n, 4))
        frozen_optional(self, "descriptors", np.float32, (n, None))
        frozen_optional(self, "track_ids", np.int64, (n,))
        for name in ("labels", "masks", "mask_sources", "points_m", "texts"):
            parts = getattr(self, name)
            if len(parts) != n and (parts or name == "labels"):
                raise ValueError(f"ObjectDetections: {n} boxes with {len(parts)} {name}")
        object.__setattr__(self, "masks", tuple(map(read_only, self.masks)))
        object.__setattr__(self, "points_m", tuple(map(read_only, self.points_m)))
        for row, mask in enumerate(self.masks):
            rows, columns = self.window(row)
            expected = rows.stop - rows.start, columns.stop - columns.start
            if mask.shape != expected or mask.dtype != np.bool_:
                found = f"{mask.dtype} {mask.shape}"
                raise ValueError(f"ObjectDetections: mask {row}: expected bool {expected}, {found}")

    def __len__(self) -> int:
        return len(self.boxes_px)

    def window(self, row: int) -> tuple[slice, slice]:
        """Return the rows and columns of pixels that a box touches, at least one of each."""
        return window(self.boxes_px[row], self.width_px, self.height_px)

    def full_mask(self, row: int) -> BoolArray:
        """Return the mask (H, W) of a detection over the whole image; that of its box if it has none."""
        full = np.zeros((self.height_px, self.width_px), np.bool_)
        full[self.window(row)] = self.masks[row] if self.masks else True
        return full


def window(box_px: npt.NDArray[np.floating], width_px: int, height_px: int) -> tuple[slice, slice]:
    """Return the rows and columns of an image's pixels that a box (4,) touches, at least one of each."""
    x_min, y_min, x_max, y_max = (float(edge) + 0.5 for edge in box_px)
    return _pixels(y_min, y_max, height_px), _pixels(x_min, x_max, width_px)


def _pixels(low: float, high: float, count: int) -> slice:
    first = min(max(int(np.floor(low)), 0), count - 1)
    return slice(first, min(max(int(np.ceil(high)), first + 1), count))
