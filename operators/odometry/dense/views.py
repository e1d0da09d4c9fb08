"""An image with depth at several sizes, and its points that a pose is found by."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import BoolArray, Float32Array, IntArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.structured_light import depth_sigma_m

_LEAST_WIDTH_PX = 40  # of the smallest image
_MAX_POINTS = 24000  # of one image: half where the picture changes, half from everywhere
_LEAST_CHANGE = 4.0  # of gray levels from pixel to pixel, so that a point tells by its colour
_JUMP = 0.1  # of the depth, between pixels that become one
_BEND = 0.04  # of the inverse depth, off the line through the neighbours: an outline, where no side can be trusted
_SMOOTH = (
    (160, 3),
    (10000, 5),
)  # slopes of depth are those over so many pixels, by the width: noise is no slope


@dataclass(frozen=True, eq=False)
class Points:
    """Pixels of a view with what they say of its motion, by colour and by depth."""

    xyz: Float32Array  # (N, 3) in the camera's frame [m]
    gray: Float32Array  # (N,)
    sigma_m: Float32Array  # (N,) of the depths
    J_gray: Float32Array  # (N, 6) of gray levels by a motion of the points, rotation first
    J_depth: Float32Array  # (N, 6) of depth less the point's own, in sigmas


@dataclass(frozen=True, eq=False)
class Level:
    """The view at one size."""

    gray: Float32Array  # (H, W)
    depth_m: Float32Array  # (H, W), NaN: unknown
    focal_px: tuple[float, float]
    center_px: tuple[float, float]

    def half(self) -> Level:
        """Return the view at half the size."""
        height, width = (size // 2 for size in self.gray.shape)
        gray = cv2.resize(
            self.gray[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA
        )
        (fx, fy), (cx, cy) = self.focal_px, self.center_px
        return Level(
            gray=np.asarray(gray, np.float32),
            depth_m=_halved(self.depth_m[: 2 * height, : 2 * width]),
            focal_px=(fx / 2, fy / 2),
            center_px=((cx + 0.5) / 2 - 0.5, (cy + 0.5) / 2 - 0.5),
        )

    @cached_property
    def points(self) -> Points:
        """Return the points by which other views are aligned to this one."""
        gray_x, gray_y = (cv2.Sobel(self.gray, cv2.CV_32F, *d, scale=1 / 8) for d in _AXES)
        depth_x, depth_y = _slopes(self.depth_m)
        usable = np.isfinite(depth_x) & np.isfinite(depth_y)
        rows, columns = _chosen(usable, np.hypot(gray_x, gray_y) > _LEAST_CHANGE)
        z = self.depth_m[rows, columns]
        (fx, fy), (cx, cy) = self.focal_px, self.center_px
        xyz = np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], axis=1)
        sigma_m = depth_sigma_m(z.astype(np.float64)).astype(np.float32)
        by_point = []
        for dx, dy in ((gray_x, gray_y), (depth_x, depth_y)):
            gx, gy = dx[rows, columns] * fx / z, dy[rows, columns] * fy / z
            by_point.append(np.stack([gx, gy, -(gx * xyz[:, 0] + gy * xyz[:, 1]) / z], axis=1))
        by_point[1][:, 2] -= 1
        by_point[1] /= sigma_m[:, None]
        J_gray, J_depth = (
            np.hstack([np.cross(xyz, g), g]).astype(np.float32, copy=False) for g in by_point
        )
        gray = self.gray[rows, columns]
        return Points(xyz.astype(np.float32, copy=False), gray, sigma_m, J_gray, J_depth)


_AXES = ((1, 0), (0, 1))


def levels_of(
    gray: npt.NDArray[np.uint8], depth_m: Float32Array, camera: CameraCalibration, width_px: int
) -> list[Level]:
    """Return the view at sizes from `width_px` or less, each half the one before.

    Args:
        gray: The image (H, W).
        depth_m: Along the view (H, W); NaN: unknown.
        camera: A pinhole without distortion.
        width_px: Of the largest image that is used.
    """
    (fx, fy), (cx, cy) = camera.focal_px.tolist(), camera.center_px.tolist()
    level = Level(gray.astype(np.float32), depth_m, (fx, fy), (cx, cy))
    while level.gray.shape[1] > width_px:
        level = level.half()
    levels = [level]
    while levels[-1].gray.shape[1] // 2 >= _LEAST_WIDTH_PX:
        levels.append(levels[-1].half())
    return levels


def _halved(depth_m: Float32Array) -> Float32Array:
    """Return the means of squares of four pixels; of those in front where they are torn, NaN if none is known."""
    height, width = depth_m.shape
    four = depth_m.reshape(height // 2, 2, width // 2, 2).transpose(1, 3, 0, 2).reshape(4, -1)
    nearest = np.fmin.reduce(four)
    with np.errstate(invalid="ignore"):
        used = four < nearest * (1 + _JUMP)
    count = used.sum(axis=0)
    total = np.where(used, four, 0).sum(axis=0)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean.reshape(height // 2, width // 2).astype(np.float32)


def _slopes(depth_m: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Return how depth changes from pixel to pixel (H, W), along x and y; NaN at outlines and where it is unknown.

    They are those of the plane that fits the pixels around best.
    """
    window = next(px for width, px in _SMOOTH if depth_m.shape[1] <= width)
    reach = window // 2
    along = np.arange(-reach, reach + 1, dtype=np.float32)
    ones = np.ones(window, np.float32)
    norm = float((along**2).sum() * window)
    known = np.nan_to_num(depth_m)
    is_bad = np.asarray(cv2.dilate(_is_bent(depth_m).astype(np.uint8), np.ones((window,) * 2)))
    slopes = []
    for horizontal, vertical in ((along, ones), (ones, along)):
        slope = np.asarray(cv2.sepFilter2D(known, cv2.CV_32F, horizontal, vertical)) / norm
        slope[is_bad > 0] = np.nan
        slopes.append(slope.astype(np.float32, copy=False))
    return slopes[0], slopes[1]


def _is_bent(depth_m: Float32Array) -> BoolArray:
    """Return where depth is unknown, or not that of a plane through the neighbours (H, W).

    Along a plane the inverse depth is linear in the pixel, however much it is slanted.
    """
    inverse = np.nan_to_num(1 / depth_m)
    off = [
        np.abs(np.asarray(cv2.Sobel(inverse, cv2.CV_32F, *d, ksize=1))) for d in ((2, 0), (0, 2))
    ]
    return np.asarray((np.maximum(*off) > _BEND * inverse) | (inverse == 0))


def _chosen(usable: BoolArray, changes: BoolArray) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the points: evenly from where the picture changes, and from everywhere."""
    rows = np.flatnonzero(usable & changes)
    rows = rows[:: max(1, -(-len(rows) // (_MAX_POINTS // 2)))]
    rest = np.flatnonzero(usable)
    rest = rest[:: max(1, -(-len(rest) // (_MAX_POINTS // 2)))]
    found = np.unravel_index(np.union1d(rows, rest), usable.shape)
    return np.asarray(found[0], np.int64), np.asarray(found[1], np.int64)
