"""Connected components of an image whose neighbouring pixels are joined, or not, one by one.

Pixels and the links between them become the pixels of an image twice as large, of which OpenCV finds the components
in one pass.
Source: Trevor, Gedikli, Rusu, Christensen: Efficient organized point cloud segmentation with connected components,
SPME 2013.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.operators.planes.local_planes import DepthGrid, LocalPlanes
from mapstream.streams.arrays import BoolArray

Labels = npt.NDArray[np.int32]
Place = tuple[slice, slice]
_ALL, _BEFORE, _AFTER = slice(None), slice(None, -1), slice(1, None)


def regions(is_node: BoolArray, are_joined: Callable[[Place, Place], BoolArray]) -> Labels:
    """Return the number of each pixel's region (H, W), from 1 on; 0 where there is none.

    Args:
        is_node: Shape (H, W), pixels that belong to a region.
        are_joined: Says of the pixels in one part of the image whether they are joined with those in another,
            which are their right neighbours, or those below.
    """
    height, width = is_node.shape
    grid = np.zeros((2 * height - 1, 2 * width - 1), np.uint8)
    grid[::2, ::2] = is_node
    for links, one, other in (
        (grid[::2, 1::2], (_ALL, _BEFORE), (_ALL, _AFTER)),
        (grid[1::2, ::2], (_BEFORE, _ALL), (_AFTER, _ALL)),
    ):
        links[:] = are_joined(one, other) & is_node[one] & is_node[other]
    _, labels = cv2.connectedComponents(grid, connectivity=4, ltype=cv2.CV_32S)
    return np.ascontiguousarray(labels[::2, ::2])


def same_label_regions(labels: Labels, seeds: Labels) -> Labels:
    """Return the regions of pixels (H, W) that touch and have the same label; 0 is none.

    Args:
        labels: Of all pixels; 0 is none.
        seeds: Shape (h, w), labels of every so many rows and columns: a region without a pixel that has the label
            in both is none.
    """
    found = regions(labels > 0, lambda one, other: labels[one] == labels[other])
    step = -(-len(labels) // len(seeds))
    coarse = (slice(None, None, step), slice(None, None, step))
    is_kept = np.zeros(int(found.max()) + 1, np.bool_)
    is_kept[found[coarse][(seeds > 0) & (seeds == labels[coarse])]] = True
    return np.where(is_kept[found], found, 0)


def plane_regions(
    grid: DepthGrid, planes: LocalPlanes, *, angle_rad: float, distance_m: float
) -> Labels:
    """Return the regions in which the planes of neighbours are alike (the paper's plane comparator).

    Args:
        grid: At the pixels of the planes.
        planes: Of each pixel.
        angle_rad: Between the normals of two neighbours, at most.
        distance_m: Of the neighbour from the plane of a pixel, at most.
    """
    a, b, w, x, y = planes.a, planes.b, planes.inverse_depth, grid.x, grid.y
    c = w - a * x - b * y
    length = np.sqrt(a * a + b * b + c * c)
    length = np.maximum(length, np.float32(1e-9))
    least_cosine = np.float32(np.cos(angle_rad))

    def are_joined(one: Place, other: Place) -> BoolArray:
        dot = a[one] * a[other] + b[one] * b[other] + c[one] * c[other]
        predicted = w[one] + a[one] * (x[other] - x[one]) + b[one] * (y[other] - y[one])
        off = np.abs(predicted - w[other])  # times depth, over length: metres
        is_near: BoolArray = off < distance_m * length[one] * w[other]
        is_alike: BoolArray = dot > least_cosine * length[one] * length[other]
        return is_near & is_alike

    return regions(planes.is_flat, are_joined)
