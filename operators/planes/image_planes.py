"""Planes fitted to many pixels of a depth image, by least squares of the inverse depth.

The unknowns are q = -n / d of the plane n.p + d = 0, as in `local_planes`: the inverse depth along a ray r = (x, y, 1)
is q.r, the distance of a point p from the plane is (q.p - 1) / |q|.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.planes.local_planes import DepthGrid
from mapstream.operators.planes.regions import Labels
from mapstream.streams.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class ImagePlanes:
    """Planes in the frame of a camera."""

    q: FloatArray  # (N, 3) [1/m]
    information: FloatArray  # (N, 3, 3) of q
    mean_rays: FloatArray  # (N, 3) amid the pixels, z is 1
    num_pixels: IntArray  # (N,)
    rmse_m: FloatArray  # (N,) of the points off their plane

    def __len__(self) -> int:
        return len(self.q)

    @property
    def normals(self) -> FloatArray:
        """Return unit normals (N, 3) towards the camera."""
        normals: FloatArray = -self.q / np.linalg.norm(self.q, axis=1, keepdims=True)
        return normals

    def chosen(self, rows: IntArray) -> ImagePlanes:
        """Return some of them."""
        columns = (self.q, self.information, self.mean_rays, self.num_pixels, self.rmse_m)
        return ImagePlanes(*(column[rows] for column in columns))  # type: ignore[arg-type]  # arrays


def fitted(grid: DepthGrid, labels: Labels, count: int) -> ImagePlanes:
    """Fit a plane to the pixels with each label from 1 to `count`; each has three or more.

    What the points lie off it beyond their noise makes it less sure.
    """
    at = np.flatnonzero(labels)
    label = labels.ravel()[at] - 1
    x, y, w, sigma = (
        image.ravel()[at].astype(np.float64)
        for image in (grid.x, grid.y, grid.inverse_depth, grid.sigma)
    )
    weight = 1 / (sigma * sigma)

    def sums(values: FloatArray) -> FloatArray:
        return np.bincount(label, values, minlength=count).astype(np.float64, copy=False)

    wx, wy = weight * x, weight * y
    one, sx, sy = sums(weight), sums(wx), sums(wy)
    sxx, sxy, syy = sums(wx * x), sums(wx * y), sums(wy * y)
    normal = np.stack([sxx, sxy, sx, sxy, syy, sy, sx, sy, one], axis=1).reshape(-1, 3, 3)
    right = np.stack([sums(wx * w), sums(wy * w), sums(weight * w)], axis=1)
    q = np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0], dtype=np.float64)
    num_pixels = np.bincount(label, minlength=count)
    off = q[label, 0] * x + q[label, 1] * y + q[label, 2] - w
    chi2 = sums(weight * off * off) / num_pixels
    square_m = sums((off / w) ** 2) / num_pixels / (q * q).sum(axis=1)
    return ImagePlanes(
        q=q,
        information=normal / np.maximum(chi2, 1.0)[:, None, None],
        mean_rays=np.stack([sx, sy, one], axis=1) / one[:, None],
        num_pixels=num_pixels.astype(np.int64),
        rmse_m=np.sqrt(square_m),
    )
