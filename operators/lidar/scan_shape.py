"""What the surfaces in one scan hold of a pose, whatever it is registered to.

For registrations that know no surfaces, such as point-to-point ICP, which finds a motion along a blank corridor
in the rings of the scan.
"""

from __future__ import annotations

import numpy as np
from small_gicp import KdTree, PointCloud

from mapstream.operators.lidar.observability import observability_of_planes
from mapstream.streams.arrays import FloatArray

_NUM_PLACES = 500
_NUM_NEIGHBOURS = 12
_FLAT = 0.1  # a surface's points are so much farther spread in either direction than across ...
_WIDE = 0.05  # ... and no line
_LEAST_SURPLUS = 10.0  # normals between the rings of one scan are noisier than those of a map
_LEAST_PLACES = 30  # with fewer nothing is said


def open_directions_of_scan(points: FloatArray) -> FloatArray:
    """Return the directions (K, 6) in which a scan (N, 3) may move without any of its surfaces noticing.

    Rotation first [rad, m], in the scan's frame; none where there are too few surfaces to say so.
    """
    if len(points) < _NUM_NEIGHBOURS:
        return np.empty((0, 6))
    tree = KdTree(PointCloud(points), 1)
    chosen = np.random.default_rng(0).permutation(len(points))[
        :_NUM_PLACES
    ]  # a stride would meet the rings'
    places = points[chosen]
    neighbours, _ = tree.batch_knn_search(places, _NUM_NEIGHBOURS)
    near = points[np.asarray(neighbours, dtype=np.int64)]  # (M, K, 3)
    spread = near - near.mean(axis=1, keepdims=True)
    extents, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))
    is_flat = extents[:, 0] < _FLAT**2 * extents[:, 1]
    is_flat &= extents[:, 1] > _WIDE * extents[:, 2]
    if is_flat.sum() < _LEAST_PLACES:
        return np.empty((0, 6))
    normals = axes[is_flat, :, 0]
    found = observability_of_planes(places[is_flat], normals, 0.0, least_surplus=_LEAST_SURPLUS)
    return found.unseen
