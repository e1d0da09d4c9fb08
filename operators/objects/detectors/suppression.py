"""One box for each object: of boxes that overlap, the best."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import Float32Array, FloatArray, IntArray


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
    left = np.argsort(-scores, kind="stable")
    areas = np.prod(boxes_px[:, 2:] - boxes_px[:, :2], axis=1, dtype=np.float64)
    kept = []
    while len(left):
        best, left = left[0], left[1:]
        kept.append(best)
        shared = _shared_area(boxes_px[best], boxes_px[left])
        either = areas[best] + areas[left] - shared
        most = np.where(classes[left] == classes[best], max_overlap, max_class_overlap)
        left = left[shared <= most * either]
    return np.array(kept, np.int64)


def _shared_area(box: Float32Array, others: Float32Array) -> FloatArray:
    """Return what a box (4,) shares with each of others (N, 4)."""
    least, most = np.maximum(box[:2], others[:, :2]), np.minimum(box[2:], others[:, 2:])
    area: FloatArray = np.prod(np.maximum(most - least, 0.0), axis=1, dtype=np.float64)
    return area
