"""YOLOX: one output (B, cells, 5 + classes), each cell's box by its place in the cell (Ge et al., arXiv:2107.08430).

The image is BGR from 0 to 255 in the corner of a grey one. Sigmoids are in the graph, the grid is not, as the authors'
export has it.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from mapstream.operators.objects.detectors.candidates import Candidates
from mapstream.operators.objects.detectors.image_fit import ImageFit
from mapstream.operators.objects.detectors.layout import Layout, Outputs, Probe
from mapstream.streams.arrays import Float32Array, finite_rows

EXPECTED = "one output (B, N, 5 + classes), N cells of 8, 16, 32 (and 64) px"
_STRIDES_PX = ((8, 16, 32), (8, 16, 32, 64))
_LARGEST = 20.0  # logarithm of a side in cells; more is beyond any image, and overflows


def layout(probe: Probe) -> Layout | None:
    """Return the layout if this is such a network."""
    names = probe.of_rank(3)
    if len(names) != 1 or len(probe.outputs) != 1:
        return None
    _, num_cells, width = probe.outputs[names[0]].shape
    grids = [_cells(probe.size_px, strides_px) for strides_px in _STRIDES_PX]
    cells = next((grid for grid in grids if len(grid) == num_cells), None)
    if cells is None or width < 6:
        return None
    read = partial(_read, name=names[0], cells=cells)
    return Layout(read, num_classes=width - 5, is_rgb=False, most=255.0)


def _cells(size_px: tuple[int, int], strides_px: tuple[int, ...]) -> Float32Array:
    """Return column, row and side [px] of all cells (N, 3)."""
    parts = []
    for stride in strides_px:
        rows, columns = np.mgrid[: size_px[1] // stride, : size_px[0] // stride]
        parts.append(np.stack([columns, rows, np.full_like(rows, stride)], axis=-1).reshape(-1, 3))
    return np.concatenate(parts).astype(np.float32)


def _read(
    outputs: Outputs, fit: ImageFit, least_score: float, *, name: str, cells: Float32Array
) -> Candidates:
    rows = outputs[name]
    chosen = np.flatnonzero(~(rows[:, 4] < least_score))  # what is no number is chosen, and told of
    whole = finite_rows(rows[chosen])
    rows, cells = rows[chosen[whole]].astype(np.float64), cells[chosen[whole]]
    sure = np.minimum(rows[:, 4:], 1.0)
    middle = (rows[:, :2] + cells[:, :2]) * cells[:, 2:]
    half = np.exp(np.minimum(rows[:, 2:4], _LARGEST)) * cells[:, 2:] / 2
    return Candidates(
        boxes_px=fit.boxes(np.hstack([middle - half, middle + half])),
        scores=(sure[:, 0] * sure[:, 1:].max(axis=1)).astype(np.float32),
        classes=rows[:, 5:].argmax(axis=1),
        num_broken=int(len(whole) - whole.sum()),
    )
