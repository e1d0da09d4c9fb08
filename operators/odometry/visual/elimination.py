"""Points eliminated from what their keypoints say, so that constraints between poses are left (Schur complement)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.odometry.visual.sightings import Grouped
from mapstream.operators.odometry.visual.triangulation import (
    Points,
    by_pose,
    gains_at,
    triangulate,
)
from mapstream.streams.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Eliminated:
    """What F points say of K poses, C = 6 K columns, perturbed on the left; and how the points follow the poses."""

    points: Points
    H: FloatArray  # (F, M, C) in units of sigma, without what a shift of the point explains
    residuals: FloatArray  # (F, M) measured less expected, the same
    point_by_poses: FloatArray  # (F, 3, C)
    point_roots: FloatArray  # (F, 3, 3) roots of the points' covariances, were the poses exact
    point_shift: FloatArray  # (F, 3) from where they were triangulated to where they fit best

    def information(self) -> tuple[FloatArray, FloatArray]:
        """Return H^T H (F, C, C) and H^T r (F, C)."""
        H = self.H
        return np.swapaxes(H, 1, 2) @ H, np.einsum("fij,fi->fj", H, self.residuals)


def eliminate(group: Grouped, num_poses: int) -> Eliminated:
    """Triangulate points, and return what they say of the poses that saw them."""
    points = triangulate(group.views)
    residuals, gains = gains_at(group.views, points.positions)
    by_image = by_pose(gains, points.positions[:, None])
    (num, most), size = group.images.shape, residuals.shape[2]
    spread = np.zeros((num, most, size, num_poses, 6))
    f, m = np.nonzero(group.images >= 0)
    spread[f, m, :, group.images[f, m]] = by_image[f, m]
    H = spread.reshape(num, size * most, 6 * num_poses)
    of_point = (gains @ points.axes[:, None]).reshape(num, size * most, 3)
    r = -residuals.reshape(num, size * most)
    Pt = np.swapaxes(of_point, 1, 2)
    C = np.linalg.inv(Pt @ of_point + 1e-9 * np.eye(3))
    follow = -C @ (Pt @ H)
    shift = (C @ (Pt @ r[..., None]))[..., 0]
    axes = points.axes
    return Eliminated(
        points,
        H + of_point @ follow,
        r - (of_point @ shift[..., None])[..., 0],
        axes @ follow,
        axes @ np.linalg.cholesky((C + np.swapaxes(C, 1, 2)) / 2),
        (axes @ shift[..., None])[..., 0],
    )
