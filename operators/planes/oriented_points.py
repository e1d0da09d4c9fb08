"""Points of a cloud that was thinned out, each with the normal of the surface around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mapstream.operators.lidar.sampling import voxel_indices
from mapstream.streams.arrays import BoolArray, FloatArray

_NEIGHBORS = 12
_FLAT = 0.05  # least variance over the middle one, at most, of what has a normal


@dataclass(frozen=True, slots=True, eq=False)
class OrientedPoints:
    """Points on surfaces."""

    points: FloatArray  # (N, 3) [m]
    normals: FloatArray  # (N, 3) towards the sensor

    def __len__(self) -> int:
        return len(self.points)

    def chosen(self, mask: BoolArray) -> OrientedPoints:
        """Return some of them."""
        return OrientedPoints(self.points[mask], self.normals[mask])


def oriented_points(
    points: npt.NDArray[np.floating], origin: FloatArray, *, voxel_size_m: float, radius_m: float
) -> OrientedPoints:
    """Return a point for each voxel whose surroundings are flat.

    Args:
        points: Shape (N, 3).
        origin: The sensor (3,), which sees the front of surfaces.
        voxel_size_m: Of the thinning out.
        radius_m: What is further away does not belong to a point's surroundings.
    """
    from scipy.spatial import KDTree  # noqa: PLC0415  # heavy

    thin = points[voxel_indices(points, voxel_size_m)].astype(np.float64)
    if len(thin) < _NEIGHBORS:
        return OrientedPoints(np.empty((0, 3)), np.empty((0, 3)))
    distances, rows = KDTree(thin).query(thin, k=_NEIGHBORS)
    weight = (distances <= radius_m).astype(np.float64)[:, :, None]
    count = weight.sum(axis=1)
    around = thin[rows]
    spread = weight * (around - (weight * around).sum(axis=1, keepdims=True) / count[:, None])
    variances, axes = np.linalg.eigh(np.swapaxes(spread, 1, 2) @ spread)
    is_flat = (count[:, 0] >= _NEIGHBORS / 2) & (variances[:, 0] < _FLAT * variances[:, 1])
    thin, normals = thin[is_flat], axes[is_flat, :, 0]
    side = np.sign(np.einsum("ni,ni->n", normals, origin - thin))
    return OrientedPoints(thin, normals * side[:, None])
