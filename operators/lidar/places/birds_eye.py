"""A place from above: a levelled cloud as an image of how much stands in each column, and corners in it.

Source: Gupta et al., Effectively detecting loop closures using point cloud density maps, ICRA 2024 (MapClosures).
Here a column counts the heights at which something stands, not its points: floors, ceilings and the number of
scans matter little then.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.lidar.sampling import voxel_indices
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import FloatArray, frozen
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, so3_exp

_GROUND_CELL_M = 1.0
# Points farther off the ground hardly count: a wide look first, which sees tilts, then closer ones.
_GROUND_WIDTHS_M = np.geomspace(3.0, 0.15, 10)
_MIN_CELLS = 10
_FULL_SHARE = 0.95  # of the columns with something in them, those below full white


class BirdsEyeConfig(OperatorConfig):
    """How a place looks from above."""

    cell_m: PositiveFloat = 0.2
    """Side of a pixel."""
    radius_m: PositiveFloat = 30.0
    """Points farther away are left out."""
    height_step_m: PositiveFloat = 0.2
    """Of the heights that are counted in a column."""
    min_height_m: NonNegativeFloat = 0.3
    """Over the ground; what is lower is ground."""
    max_height_m: PositiveFloat = 10.0
    """Over the ground; what is higher is left out."""
    max_tilt_deg: PositiveFloat = 30.0
    """Of the base against the ground; more is no ground."""
    num_features: PositiveInt = 500
    """Of an image, at most."""
    patch_px: PositiveInt = 31
    """Side of what a feature looks at."""
    threshold: PositiveInt = 20
    """Of corners."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BirdsEye:
    """Features of a place seen from above."""

    T_level_base: SE3  # level: z up, zero on the ground below the base
    positions: FloatArray  # (N, 2) of the features in the level frame [m]
    descriptors: npt.NDArray[np.uint8]  # (N, 32)

    def __post_init__(self) -> None:
        n = frozen(self, "positions", np.float64, (None, 2)).shape[0]
        frozen(self, "descriptors", np.uint8, (n, None))


def birds_eye(points: FloatArray, config: BirdsEyeConfig) -> BirdsEye:
    """Return what a local map (N, 3) in its base frame looks like from above.

    Raises:
        EstimationError: If there is no ground below the base.
    """
    T_level_base = levelling(points, config.max_tilt_deg)
    level = T_level_base @ points
    image, origin_m = density_image(level, config)
    found, descriptors = _detector(config).detectAndCompute(image, None)
    if descriptors is None:
        found, descriptors = (), np.empty((0, 32), np.uint8)
    pixels = np.array([point.pt for point in found]).reshape(-1, 2)
    positions = origin_m + (pixels + 0.5) * config.cell_m
    return BirdsEye(T_level_base=T_level_base, positions=positions, descriptors=descriptors)


def density_image(
    level: FloatArray, config: BirdsEyeConfig
) -> tuple[npt.NDArray[np.uint8], FloatArray]:
    """Return how much stands in each column (H, W), and where the first pixel's corner lies (2,) [m].

    Columns of the image go along x, rows along y.
    """
    is_inside = (level[:, 2] >= config.min_height_m) & (level[:, 2] <= config.max_height_m)
    is_inside &= np.hypot(level[:, 0], level[:, 1]) <= config.radius_m
    half = int(np.ceil(config.radius_m / config.cell_m))
    scaled = level[is_inside] / [config.cell_m, config.cell_m, config.height_step_m]
    cells = np.floor(scaled[voxel_indices(scaled, 1.0)]).astype(np.int64)
    flat = (cells[:, 1] + half) * (2 * half) + cells[:, 0] + half
    counts = np.bincount(flat, minlength=4 * half * half).reshape(2 * half, 2 * half)
    full = max(float(np.quantile(counts[counts > 0], _FULL_SHARE)), 1.0) if counts.any() else 1.0
    image = np.clip(255 * counts / full, 0, 255).astype(np.uint8)
    return image, np.full(2, -half * config.cell_m)


def levelling(points: FloatArray, max_tilt_deg: float) -> SE3:
    """Return where the base is over the ground: T_level_base, z up, x as near to the base's as can be.

    Raises:
        EstimationError: If the lowest points are no ground.
    """
    lowest = _lowest(points)
    if len(lowest) < _MIN_CELLS:
        raise EstimationError(f"{len(lowest)} columns of points are too few to find the ground in")
    columns = np.column_stack([lowest[:, :2], np.ones(len(lowest))])
    plane = np.array([0.0, 0.0, np.quantile(lowest[:, 2], 0.2)])
    for width_m in _GROUND_WIDTHS_M:
        above = lowest[:, 2] - columns @ plane
        weights = 1 / (1 + (above / width_m) ** 2) ** 2  # Geman and McClure
        weighted = columns * weights[:, None]
        plane = np.linalg.solve(weighted.T @ columns + 1e-6 * np.eye(3), weighted.T @ lowest[:, 2])
    normal = np.array([-plane[0], -plane[1], 1.0]) / np.sqrt(1 + plane[0] ** 2 + plane[1] ** 2)
    tilt_deg = float(np.rad2deg(np.arccos(normal[2])))
    if tilt_deg > max_tilt_deg:
        raise EstimationError(f"the ground is tilted by {tilt_deg:.0f} deg against the base")
    axis = np.cross(normal, [0.0, 0.0, 1.0])
    length = float(np.linalg.norm(axis))
    R = so3_exp(axis / length * np.arcsin(min(length, 1.0))) if length > 1e-12 else np.eye(3)
    return SE3.from_rotation(R, [0.0, 0.0, -float(normal[2] * plane[2])])


def _lowest(points: FloatArray) -> FloatArray:
    """Return the lowest point of each column (M, 3)."""
    upwards = points[np.argsort(points[:, 2], kind="stable")]
    flat = upwards * [1.0, 1.0, 0.0]
    return upwards[voxel_indices(flat, _GROUND_CELL_M)]


def _detector(config: BirdsEyeConfig) -> Any:  # noqa: ANN401  # of OpenCV
    return cv2.ORB.create(
        nfeatures=config.num_features,
        scaleFactor=1.2,
        nlevels=1,  # metres are metres
        edgeThreshold=config.patch_px // 2,
        patchSize=config.patch_px,
        fastThreshold=config.threshold,
    )
