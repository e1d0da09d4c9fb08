"""What the surfaces in one scan hold of a pose, whatever it is registered to.

For registrations that know no surfaces, such as point-to-point ICP, which finds a motion along a blank corridor
in the rings of the scan.
"""

from __future__ import annotations

import numpy as np
from small_gicp import KdTree, PointCloud

from mapstream.operators.lidar.observability import observability_of_planes
from mapstream.streams.arrays import FloatArray

_NUM_PLACES = 300
_NUM_NEIGHBOURS = 12
_WIDE = (
    0.05  # a surface's points are spread so much more along it than a line's, in either direction
)
# Where a room or a street holds a scan it is 35 and more, in a blank corridor 2; below 20, with a far end
# in view, KISS-ICP still loses a tenth of the way.
_LEAST_SURPLUS = 25.0
_LEAST_PLACES = 30  # with fewer nothing is said
_NEARLY = 1.5  # a surplus below so many times the least may soon be too little
_SELDOM = 4  # scans; surroundings that hold a scan well do not let it go within less


class OpenDirections:
    """The directions that scan after scan leaves open; asks each scan where it is close, else only some."""

    def __init__(self) -> None:
        self._num_to_skip = 0

    def of(self, points: FloatArray) -> FloatArray:
        """Return the directions (K, 6) that the next scan (N, 3) leaves open, as `open_directions_of_scan` does."""
        if self._num_to_skip:
            self._num_to_skip -= 1
            return np.empty((0, 6))
        unseen, surplus = _shape_of(points)
        self._num_to_skip = 0 if surplus < _NEARLY * _LEAST_SURPLUS else _SELDOM - 1
        return unseen


def open_directions_of_scan(points: FloatArray) -> FloatArray:
    """Return the directions (K, 6) in which a scan (N, 3) may move without any of its surfaces noticing.

    Rotation first [rad, m], in the scan's frame; none where there are too few surfaces to say so.
    """
    return _shape_of(points)[0]


def _shape_of(points: FloatArray) -> tuple[FloatArray, float]:
    """Return the open directions, and how far the weakest direction stands out of noise.

    A place counts by the direction in which its neighbourhood is thinnest, however thick that is: plants and
    small things have any such direction, and hold a scan in all.
    """
    nothing = np.empty((0, 6)), 0.0
    if len(points) < _NUM_NEIGHBOURS:
        return nothing
    # At random, for a stride would meet the rings'.
    chosen = np.random.default_rng(0).permutation(len(points))[:_NUM_PLACES]
    places = points[chosen]
    tree = KdTree(PointCloud(points), 1)
    neighbours, _ = tree.batch_knn_search(places, _NUM_NEIGHBOURS)
    near = points[np.asarray(neighbours, dtype=np.int64)]  # (M, K, 3)
    spread = near - near.mean(axis=1, keepdims=True)
    extents, axes = np.linalg.eigh(spread.transpose(0, 2, 1) @ spread)
    is_surface = extents[:, 1] > _WIDE * extents[:, 2]
    if is_surface.sum() < _LEAST_PLACES:
        return nothing
    normals = axes[is_surface, :, 0]
    found = observability_of_planes(places[is_surface], normals, 0.0, least_surplus=_LEAST_SURPLUS)
    return found.unseen, found.least_surplus
