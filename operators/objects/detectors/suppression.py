"""One box for each object: of boxes that overlap, the best."""

from __future__ import annotations

import numpy as np

from mapstream.operators.objects.box_areas import intersection_over_union
from mapstream.streams.arrays import Float32Array, IntArray


def distinct(
    boxes_px: Float32Array,
    scores: Float32Array,
    classes: IntArray,
    *,
    max_overlap: float,
    max_class_overlap: float,
) -> IntArray:
    """Return rows of boxes that overlap no better one, the best first.

    Args:
        boxes_px: Shape (N, 4).
        scores: Shape (N,).
        classes: Shape (N,).
        max_overlap: The most that two of a class may overlap: what both cover as a share of what either does.
        max_class_overlap: The same for two of different classes: one thing may be taken for two.
    """
    order = np.argsort(-scores, kind="stable")
    left = np.vstack([boxes_px[order].T, classes[order], order]).astype(np.float64)
    kept = []
    while left.shape[1]:
        best, left = left[:, 0], left[:, 1:]
        kept.append(int(best[5]))
        most = np.where(left[4] == best[4], max_overlap, max_class_overlap)
        left = left[:, intersection_over_union(best, left) <= most]
    return np.array(kept, np.int64)
