"""What a LiDAR saw as an image of 8 bits: range and intensity on logarithmic scales, fused, without a gap.

Sources: Streiff et al., 3D3L: Deep Learned 3D Keypoint Detection and Description for LiDARs, ICRA 2021;
Cramariuc et al., maplab 2.0, RA-L 2023, section IV-C. Mertens, Kautz, Van Reeth, Exposure Fusion, PG 2007;
Telea, An Image Inpainting Technique Based on the Fast Marching Method, JGT 2004.
"""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.features.gray import GrayImage
from mapstream.operators.lidar.images.grid import GridConfig, ProjectedScan
from mapstream.streams.arrays import BoolArray, Float32Array

_SMOOTHED_BEAMS = 5  # whose gains differ
_MEDIAN_PX = 3
_SEAM_PX = 64  # painted twice, so that pixels at the seam see both sides
_LEARNT_PERCENTILES = (1.0, 99.0)


class PictureConfig(GridConfig):
    """How a scan becomes an image; the numbers are maplab's."""

    fuse: Literal["gradient", "range"] = "gradient"
    """What is fused with the intensity: how much the range changes, or the range."""
    range_k: PositiveFloat = 1.0
    """Of the logarithmic scale [1/m]: the larger, the more of it is for what is near."""
    min_intensity: NonNegativeFloat | None = None
    """Where the scale of intensities begins and ends, such as 2 and 3000; learnt from the first scan without."""
    max_intensity: PositiveFloat | None = None
    intensity_k: PositiveFloat = 5.0
    inpaint_radius_px: PositiveInt = 5
    """Pixels without a point are painted from those in this radius."""


def logarithmic(
    values: npt.NDArray[np.floating], low: float, high: float, k: float
) -> Float32Array:
    """Return values on a scale from 0 at `low` to 255 at `high`: 255 ln(1 + k (x - low)) / ln(1 + k (high - low))."""
    above = np.clip(values, low, high).astype(np.float32) - np.float32(low)
    scaled: Float32Array = np.log1p(k * above) * np.float32(255 / np.log1p(k * (high - low)))
    return scaled


def range_gradient(scaled_range: Float32Array) -> Float32Array:
    """Return how much a range image (H, W) of 0 to 255 changes around each pixel, 0 to 255."""
    smooth = cv2.GaussianBlur(scaled_range, (3, 3), 0)
    across, down = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    mean: Float32Array = np.minimum((np.abs(across) + np.abs(down)) / 2, np.float32(255))
    return mean


def smooth_intensity(scaled_intensity: Float32Array) -> Float32Array:
    """Return an intensity image (H, W) without the gains of single beams, and without single bright pixels."""
    even = cv2.blur(scaled_intensity, (1, _SMOOTHED_BEAMS))
    return np.asarray(cv2.medianBlur(even, _MEDIAN_PX), np.float32)


def fused(first: GrayImage, second: GrayImage) -> GrayImage:
    """Return the exposure fusion of two images (H, W)."""
    merged = cv2.createMergeMertens().process([first, second])
    return eight_bits(np.asarray(merged, np.float32) * 255)


def painted_over(values: Float32Array, is_measured: BoolArray, radius_px: int) -> Float32Array:
    """Return an image (H, W) of 0 to 255 whose pixels without a measurement are painted from their neighbours."""
    if is_measured.all() or not is_measured.any():
        return values
    mask = (~is_measured).astype(np.uint8)
    painted = cv2.inpaint(eight_bits(values), mask, radius_px, cv2.INPAINT_TELEA)
    return np.where(is_measured, values, painted).astype(np.float32)


def eight_bits(values: Float32Array) -> GrayImage:
    """Return values rounded into 0 to 255."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


class Painter:
    """Paints projected scans of one LiDAR."""

    def __init__(self, config: PictureConfig) -> None:
        self._config = config
        self._intensities: tuple[float, float] | None = None

    def paint(self, projected: ProjectedScan) -> GrayImage:
        """Return the image (H, W); it has no seam where the yaw begins anew."""
        config = self._config
        is_measured = wrapped(projected.is_measured)
        near, far = config.min_range_m, config.max_range_m
        scaled = logarithmic(wrapped(projected.range_m), near, far, config.range_k)
        shape = painted_over(scaled, is_measured, config.inpaint_radius_px)
        shown = range_gradient(shape) if config.fuse == "gradient" else shape
        intensity = projected.scan.intensity
        if intensity is None:
            return unwrapped(eight_bits(shown))
        low, high = self._limits(intensity)
        measured = intensity[projected.point]
        bright = logarithmic(wrapped(measured), low, high, config.intensity_k)
        bright = painted_over(bright, is_measured, config.inpaint_radius_px)
        return unwrapped(fused(eight_bits(shown), eight_bits(smooth_intensity(bright))))

    def _limits(self, seen: Float32Array) -> tuple[float, float]:
        """Return where the scale of intensities begins and ends."""
        if self._intensities is None:
            low, high = np.percentile(seen, _LEARNT_PERCENTILES) if len(seen) else (0.0, 1.0)
            low = low if self._config.min_intensity is None else self._config.min_intensity
            high = high if self._config.max_intensity is None else self._config.max_intensity
            self._intensities = float(low), float(max(high, low + 1e-6))
        return self._intensities


def wrapped(image: npt.NDArray[Any], px: int = _SEAM_PX) -> npt.NDArray[Any]:
    """Return an image (H, W) with its last columns before the first, and its first behind the last."""
    return np.pad(image, ((0, 0), (px, px)), mode="wrap")


def unwrapped(image: npt.NDArray[Any], px: int = _SEAM_PX) -> npt.NDArray[Any]:
    """Return what `wrapped` was given."""
    return np.ascontiguousarray(image[:, px:-px])
