"""YOLOv8 and YOLO11 with masks: boxes with coefficients, and prototypes of masks that they add up.

Outputs are (B, 4 + classes + M, N) with x, y, width and height in pixels of the network, and (B, M, h, w); without the
second there are boxes alone. The image is RGB from 0 to 1 in the middle of a grey one.
Source: Ultralytics' export to ONNX without suppression; for the prototypes Bolya et al., YOLACT, ICCV 2019.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from mapstream.operators.objects.detectors.candidates import Candidates, sampled
from mapstream.operators.objects.detectors.image_fit import ImageFit
from mapstream.operators.objects.detectors.layout import Layout, Outputs, Probe
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, finite_rows

EXPECTED = "outputs (B, 4 + classes + M, N) and, for masks, (B, M, h, w); exported without nms"


@dataclass(frozen=True, slots=True)
class _Ends:
    """Of one network."""

    boxes: str
    prototypes: str | None
    num_classes: int
    size_px: tuple[int, int]  # of its image


def layout(probe: Probe) -> Layout | None:
    """Return the layout if this is such a network."""
    boxes, prototypes = probe.of_rank(3), probe.of_rank(4)
    if len(boxes) != 1 or len(prototypes) > 1 or len(boxes + prototypes) != len(probe.outputs):
        return None
    _, width, num_boxes = probe.outputs[boxes[0]].shape
    num_coefficients = probe.outputs[prototypes[0]].shape[1] if prototypes else 0
    num_classes = width - 4 - num_coefficients
    if num_classes < 1 or num_boxes <= width:  # a table on its side is of another network
        return None
    ends = _Ends(boxes[0], prototypes[0] if prototypes else None, num_classes, probe.size_px)
    read = partial(_read, ends=ends)
    return Layout(read, num_classes=num_classes, fit="middle")


def _read(outputs: Outputs, fit: ImageFit, least_score: float, *, ends: _Ends) -> Candidates:
    table = outputs[ends.boxes]
    best = table[4 : 4 + ends.num_classes].max(axis=0)
    chosen = np.flatnonzero(~(best < least_score))  # what is no number is chosen, and told of
    whole = finite_rows(table[:, chosen].T)
    rows = table[:, chosen[whole]].T
    sure = rows[:, 4 : 4 + ends.num_classes]
    middle, sides = np.hsplit(rows[:, :4].astype(np.float64), 2)
    masks = None
    if ends.prototypes is not None:
        coefficients = rows[:, 4 + ends.num_classes :]
        masks = _Prototypes(outputs[ends.prototypes], coefficients, fit, ends.size_px)
    return Candidates(
        boxes_px=fit.boxes(np.hstack([middle - sides / 2, middle + sides / 2])),
        scores=sure.max(axis=1),
        classes=sure.argmax(axis=1),
        masks=masks,
        num_broken=int(len(whole) - whole.sum()),
    )


@dataclass(frozen=True, slots=True)
class _Prototypes:
    """Masks as sums of prototypes (M, h, w), each with its coefficients (N, M)."""

    prototypes: Float32Array
    coefficients: Float32Array
    fit: ImageFit
    size_px: tuple[int, int]  # of the network's image

    def mask(self, row: int, box_px: Float32Array, size_px: tuple[int, int]) -> BoolArray:
        """Return where the sum is positive, which is where its sigmoid is over a half."""
        # not as a product of matrices, for which numpy would start threads of its own
        sums = np.einsum("m,mhw->hw", self.coefficients[row], self.prototypes)
        cells: FloatArray = np.array(sums.shape[::-1]) / self.size_px  # per pixel of the network
        offset = np.array(self.fit.offset_px) * cells
        is_inside: BoolArray = sampled(sums, self.fit.scale * cells, offset, box_px, size_px) > 0
        return is_inside
