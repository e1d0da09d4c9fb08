"""How a camera maps rays to pixels: the parameters, checked; `camera_models` has the maps themselves.

Models: pinhole, and the unified model (Mei and Rives, Single View Point Omnidirectional Camera
Calibration from Planar Grids, ICRA 2007). Distortions are named as in maplab and ROS.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from mapstream.streams.arrays import FloatArray, frozen

CameraModel = Literal["pinhole", "unified"]
Distortion = Literal["none", "radtan", "equidistant", "fov", "rational_polynomial"]

_NUM_PARAMETERS: dict[Distortion, tuple[int, ...]] = {
    "none": (0,),
    "radtan": (4, 5),  # k1 k2 p1 p2 [k3], as OpenCV and ROS' plumb_bob
    "equidistant": (4,),  # k1 k2 k3 k4, as OpenCV's fisheye
    "fov": (1,),  # w
    "rational_polynomial": (8,),  # k1 k2 p1 p2 k3 k4 k5 k6
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraCalibration:
    """One camera's intrinsics, valid from `stamp_ns` on."""

    stamp_ns: int = 0
    frame: str = "camera"
    model: CameraModel = "pinhole"
    width_px: int
    height_px: int
    focal_px: FloatArray  # (2,) x, y
    center_px: FloatArray  # (2,) x, y; the middle of the first pixel is (0, 0)
    xi: float | None = None  # of the unified model: the mirror parameter
    distortion: Distortion = "none"
    distortion_parameters: FloatArray  # (N,) in the order of `Distortion`'s table
    line_delay_ns: int = 0  # between two rows of a rolling shutter

    def __post_init__(self) -> None:
        name = f"CameraCalibration of {self.frame}"
        if self.width_px <= 0 or self.height_px <= 0:
            raise ValueError(f"{name}: an image of {self.width_px} x {self.height_px} px")
        if self.model not in get_args(CameraModel) or self.distortion not in _NUM_PARAMETERS:
            raise ValueError(f"{name}: no model {self.model!r} with distortion {self.distortion!r}")
        if (self.xi is None) != (self.model == "pinhole"):
            raise ValueError(f"{name}: xi belongs to the unified model and to no other")
        frozen(self, "center_px", np.float64, (2,))
        focal_px = frozen(self, "focal_px", np.float64, (2,))
        if not (focal_px > 0).all():
            raise ValueError(f"{name}: focal lengths are positive, not {focal_px.tolist()}")
        count = frozen(self, "distortion_parameters", np.float64, (None,)).shape[0]
        expected = _NUM_PARAMETERS[self.distortion]
        if count not in expected:
            wanted = " or ".join(map(str, expected))
            raise ValueError(f"{name}: {self.distortion} has {wanted} parameters, not {count}")

    def resized(self, width_px: int, height_px: int) -> CameraCalibration:
        """Return the calibration of the same images in another size; edges of pixels stay edges.

        Raises:
            ValueError: If a size is not positive.
        """
        scale = np.array([width_px / self.width_px, height_px / self.height_px])
        return replace(
            self,
            width_px=width_px,
            height_px=height_px,
            focal_px=self.focal_px * scale,
            center_px=(self.center_px + 0.5) * scale - 0.5,
            line_delay_ns=round(self.line_delay_ns / scale[1]) if self.line_delay_ns else 0,
        )

    @property
    def camera_matrix(self) -> FloatArray:
        """Return K (3, 3) [px]."""
        K = np.eye(3)
        K[[0, 1], [0, 1]] = self.focal_px
        K[:2, 2] = self.center_px
        return K


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeImageCalibration:
    """A LiDAR seen as a camera: columns are azimuths, rows are elevations (maplab's camera-3d-lidar)."""

    width_px: int
    height_px: int
    horizontal_resolution_rad: float
    vertical_resolution_rad: float
    vertical_center_rad: float
    horizontal_center_rad: float
    line_delay_ns: int = 0  # between two columns
