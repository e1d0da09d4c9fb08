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
    order = np.argsort(-scores, kind="stable")
    left = np.vstack([boxes_px[order].T, classes[order], order]).astype(np.float64)
    kept = []
    while left.shape[1]:
        best, left = left[:, 0], left[:, 1:]
        kept.append(int(best[5]))
        most = np.where(left[4] == best[4], max_overlap, max_class_overlap)
        left = left[:, _overlap(best, left) <= most]
    return np.array(kept, np.int64)


def _overlap(box: FloatArray, others: FloatArray) -> FloatArray:
    """Return what a box (4 or more,) and others (4 or more, N) both cover as a share of what either does.

    Coordinate by coordinate: numpy's sums over short axes take most of the time otherwise.
    """
    width = np.minimum(box[2], others[2]) - np.maximum(box[0], others[0])
    height = np.minimum(box[3], others[3]) - np.maximum(box[1], others[1])
    shared = np.maximum(width, 0.0) * np.maximum(height, 0.0)
    own = (box[2] - box[0]) * (box[3] - box[1])
    either = own + (others[2] - others[0]) * (others[3] - others[1]) - shared
    overlap: FloatArray = shared / either
    return overlap
