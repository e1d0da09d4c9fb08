"""The plane around each pixel of a depth image.

A plane n.p + d = 0 that a camera sees along rays (x, y, 1) has the inverse depth w = a x + b y + c with
(a, b, c) = -n / d: linear in the rays, and with noise that hardly depends on the depth where the noise of depth
grows with its square. So a least-squares plane per pixel needs nothing but means over a window.
Source: Badino, Huber, Park, Kanade: Fast and accurate computation of surface normals from range images,
ICRA 2011 (least squares in the image, by box filters).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import BoolArray, Float32Array

_LEAST_KNOWN = 0.5  # of the pixels in a window
_LEAST_SPREAD = 1e-12  # determinant of the rays' covariance


@dataclass(frozen=True, slots=True, eq=False)
class DepthGrid:
    """Inverse depth of pixels, how sure it is, and where the pixels look."""

    inverse_depth: Float32Array  # (H, W) [1/m]; 0 where nothing was seen
    sigma: Float32Array  # (H, W) [1/m]
    x: Float32Array  # (H, W) of the rays (x, y, 1)
    y: Float32Array  # (H, W)

    def every(self, step: int) -> DepthGrid:
        """Return every so many rows and columns."""
        kept = (slice(None, None, step), slice(None, None, step))
        return DepthGrid(self.inverse_depth[kept], self.sigma[kept], self.x[kept], self.y[kept])


@dataclass(frozen=True, slots=True, eq=False)
class LocalPlanes:
    """A plane for each pixel, as far as its window is flat."""

    a: Float32Array  # (H, W)
    b: Float32Array  # (H, W)
    inverse_depth: Float32Array  # (H, W) of the plane at the pixel [1/m]
    is_flat: BoolArray  # (H, W)


def local_planes(grid: DepthGrid, *, window_px: int, step: int, most_chi2: float) -> LocalPlanes:
    """Fit a plane to the window around pixels.

    Args:
        grid: The whole image.
        window_px: Side of the window.
        step: Every so many rows and columns have a plane: windows of neighbours are nearly the same.
        most_chi2: Mean square of the points off the plane, in units of sigma, in a window that is flat.
    """

    def means(image: Float32Array) -> Float32Array:
        size = (window_px, window_px)
        found = cv2.boxFilter(image, cv2.CV_32F, size, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(found[::step, ::step])

    w, x, y = grid.inverse_depth, grid.x, grid.y
    weight = (w > 0).astype(np.float32)
    share = means(weight)
    scale = 1 / np.maximum(share, _LEAST_KNOWN)
    wx, wy = weight * x, weight * y
    x_mean, y_mean, w_mean = scale * means(wx), scale * means(wy), scale * means(w)
    xx = scale * means(wx * x) - x_mean * x_mean
    xy = scale * means(wx * y) - x_mean * y_mean
    yy = scale * means(wy * y) - y_mean * y_mean
    xw = scale * means(w * x) - x_mean * w_mean
    yw = scale * means(w * y) - y_mean * w_mean
    ww = scale * means(w * w) - w_mean * w_mean
    determinant = np.maximum(xx * yy - xy * xy, _LEAST_SPREAD)
    a = (yy * xw - xy * yw) / determinant
    b = (xx * yw - xy * xw) / determinant
    here = grid.every(step)
    off = ww - a * xw - b * yw
    is_flat = (here.inverse_depth > 0) & (share >= _LEAST_KNOWN)
    is_flat &= off < most_chi2 * here.sigma * here.sigma
    fitted = w_mean + a * (here.x - x_mean) + b * (here.y - y_mean)
    return LocalPlanes(_float32(a), _float32(b), _float32(fitted), is_flat)


def _float32(image: npt.NDArray[np.floating]) -> Float32Array:
    return image.astype(np.float32, copy=False)
