"""What the cloud of a keyframe says of the floor plan: where beams ended, and where they passed.

Only what lies between two heights over the robot's ground counts: a beam passes a cell where it is between the two
above it, so that one which looks over a table, or at the floor before it, does not clear it.
"""

from __future__ import annotations

import numpy as np

from mapstream.operators.laser.odds_grid import Rays
from mapstream.streams.arrays import BoolArray, FloatArray

_PLANAR_M = 0.02  # clouds of planar lasers are no thicker


def rays_of(
    points_base: FloatArray,
    origin_base: FloatArray,
    T_map_base: FloatArray,
    band_m: tuple[float, float],
    max_range_m: float,
) -> Rays:
    """Return the rays of one cloud in the plane of the map.

    Args:
        points_base: (N, 3) where beams ended [m].
        origin_base: (3,) where they began.
        T_map_base: (4, 4).
        band_m: The least and the greatest height over the base of what stands in the way; of a cloud that is
            flat, as that of a planar laser, everything counts.
        max_range_m: Beams that are longer say only where they passed, that far.
    """
    R = T_map_base[:3, :3]
    ends, start = points_base @ R.T, origin_base @ R.T  # around the base, in the map's axes
    way = ends - start
    lengths = np.linalg.norm(way[:, :2], axis=1)
    kept = np.isfinite(lengths) & (lengths > 0)
    ends, way, lengths = ends[kept], way[kept], lengths[kept]
    is_long = lengths > max_range_m
    reach = np.where(is_long, max_range_m / np.maximum(lengths, 1e-9), 1.0)  # share of the way
    if not len(ends):
        return Rays(np.empty((0, 2)), np.empty((0, 2, 2)))
    low, high = band_m
    if np.ptp(points_base[kept, 2]) < _PLANAR_M:
        low, high = -np.inf, np.inf
    enters, leaves = _within(start[2], way[:, 2], low, high)
    leaves = np.minimum(leaves, reach)
    is_hit = (ends[:, 2] >= low) & (ends[:, 2] <= high) & ~is_long
    passes: BoolArray = enters < leaves
    xy = T_map_base[:2, 3] + start[:2]
    first, last = (xy + share[passes, None] * way[passes, :2] for share in (enters, leaves))
    return Rays(xy + way[is_hit, :2], np.stack([first, last], axis=1))


def _within(
    start_m: float, rise_m: FloatArray, low: float, high: float
) -> tuple[FloatArray, FloatArray]:
    """Return the shares (N,) of each way at which it enters and leaves the heights; leaves <= enters: never."""
    is_level = np.abs(rise_m) < 1e-9
    rise = np.where(is_level, 1.0, rise_m)
    to_low, to_high = (low - start_m) / rise, (high - start_m) / rise
    enters = np.clip(np.minimum(to_low, to_high), 0.0, 1.0)
    leaves = np.clip(np.maximum(to_low, to_high), 0.0, 1.0)
    level = (0.0, 1.0) if low <= start_m <= high else (0.0, 0.0)
    return np.where(is_level, level[0], enters), np.where(is_level, level[1], leaves)
