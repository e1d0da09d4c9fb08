"""FastestDet: one output (B, 5 + classes, h, w), a box at most for each cell of the image.

The image is BGR from 0 to 1, and fills the network's.
Source: github.com/dog-qiuqiu/FastestDet, `example/onnx-runtime/runtime.py`.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from mapstream.operators.objects.detectors.candidates import Candidates
from mapstream.operators.objects.detectors.image_fit import ImageFit
from mapstream.operators.objects.detectors.layout import Layout, Outputs, Probe
from mapstream.streams.arrays import finite_rows

EXPECTED = "one output (B, 5 + classes, H / 16, W / 16)"
_STRIDE_PX = 16
_SURE_OF_BOX, _SURE_OF_CLASS = 0.6, 0.4  # exponents of the two in the score


def layout(probe: Probe) -> Layout | None:
    """Return the layout if this is such a network."""
    names = probe.of_rank(4)
    if len(names) != 1 or len(probe.outputs) != 1:
        return None
    _, width, *grid = probe.outputs[names[0]].shape
    if tuple(grid[::-1]) != tuple(side // _STRIDE_PX for side in probe.size_px) or width < 6:
        return None
    read = partial(_read, name=names[0], size_px=probe.size_px)
    return Layout(read, num_classes=width - 5, fit="stretch", is_rgb=False)


def _read(
    outputs: Outputs, fit: ImageFit, least_score: float, *, name: str, size_px: tuple[int, int]
) -> Candidates:
    grid = outputs[name]
    num_rows, num_columns = grid.shape[1:]
    rows = grid.reshape(len(grid), -1).T
    whole = finite_rows(rows)
    sure = np.clip(np.where(whole[:, None], rows, 0.0), 0.0, None)  # scores are not negative
    scores = sure[:, 0] ** _SURE_OF_BOX * sure[:, 5:].max(axis=1) ** _SURE_OF_CLASS
    chosen = np.flatnonzero(whole & (scores >= least_score))
    cell = np.stack([chosen % num_columns, chosen // num_columns], axis=1)
    at = rows[chosen, 1:5]
    shares = [num_columns, num_rows]
    middle = (np.tanh(at[:, :2]) + cell) / shares * size_px
    half = size_px / (1.0 + np.exp(-np.clip(at[:, 2:], -30.0, 30.0))) / 2
    return Candidates(
        boxes_px=fit.boxes(np.hstack([middle - half, middle + half])),
        scores=scores[chosen].astype(np.float32),
        classes=rows[chosen, 5:].argmax(axis=1),
        num_broken=int(len(whole) - whole.sum()),
    )
