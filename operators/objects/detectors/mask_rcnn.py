"""Mask R-CNN as torchvision has it: boxes (N, 4), labels (N,), scores (N,) and masks (N, 1, h, w).

The image (3, H, W) or (1, 3, H, W) is RGB from 0 to 1, as large as it is; the network resizes it itself.
Masks are probabilities over the whole image, or over the box, where a file leaves out to paste them. Labels count from 1,
0 is the background. Outputs are told apart by their names, and where these say nothing by their shapes and types.
Source: He et al., Mask R-CNN, ICCV 2017; torchvision, `models.detection.maskrcnn_resnet50_fpn`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.operators.objects.detectors.candidates import Candidates, sampled
from mapstream.operators.objects.detectors.image_fit import ImageFit
from mapstream.operators.objects.detectors.layout import Layout, Outputs, Probe
from mapstream.streams.arrays import BoolArray, Float32Array, finite_rows
from mapstream.streams.errors import OperatorError

EXPECTED = "outputs boxes (N, 4), labels (N,), scores (N,) and, for masks, masks (N, 1, h, w)"


@dataclass(frozen=True, slots=True)
class _Names:
    """Of the outputs."""

    boxes: str
    labels: str
    scores: str
    masks: str | None


def layout(probe: Probe) -> Layout | None:
    """Return the layout if this is such a network."""
    found = {part: _output(probe.outputs, part) for part in ("boxes", "labels", "scores", "masks")}
    boxes, labels, scores, masks = found.values()
    if boxes is None or labels is None or scores is None:
        return None
    if probe.outputs[boxes].shape[1:] != (4,):
        return None
    names = _Names(boxes, labels, scores, masks)
    read = partial(_read, names=names)
    return Layout(read, pad=0.0, keeps_size=True)


def _output(outputs: Outputs, part: str) -> str | None:
    """Return the output that is meant; None if none is, or several are."""
    named = [name for name in outputs if part.rstrip("es") in name.lower()]
    alike = named or [name for name, array in outputs.items() if _is(array, part)]
    return alike[0] if len(alike) == 1 else None


def _is(array: npt.NDArray[Any], part: str) -> bool:
    if part == "boxes":
        return array.ndim == 2
    if part == "masks":
        return array.ndim in (3, 4)
    return array.ndim == 1 and (array.dtype.kind in "iu") == (part == "labels")


def _read(outputs: Outputs, fit: ImageFit, least_score: float, *, names: _Names) -> Candidates:
    boxes, scores, labels = (outputs[name] for name in (names.boxes, names.scores, names.labels))
    masks = outputs[names.masks] if names.masks is not None else None
    counts = {len(part) for part in (boxes, scores, labels, masks) if part is not None}
    if len(counts) > 1:
        raise OperatorError(f"mask_rcnn: outputs of one image with {sorted(counts)} objects")
    whole = finite_rows(boxes) & np.isfinite(scores)
    chosen = np.flatnonzero(whole & (scores >= least_score))
    source = None
    if masks is not None:
        height, width = masks.shape[-2:]
        grids = masks.reshape(-1, height, width)[chosen]
        source = _Grids(grids, boxes[chosen], fit)
    return Candidates(
        boxes_px=fit.boxes(boxes[chosen]),
        scores=scores[chosen].astype(np.float32),
        classes=labels[chosen].astype(np.int64),
        masks=source,
        num_broken=int(len(whole) - whole.sum()),
    )


@dataclass(frozen=True, slots=True)
class _Grids:
    """Probabilities (N, h, w) over the image or over its boxes (N, 4), which are in the network's pixels."""

    grids: npt.NDArray[Any]
    corners_px: npt.NDArray[np.floating]
    fit: ImageFit

    def mask(self, row: int, box_px: Float32Array, size_px: tuple[int, int]) -> BoolArray:
        """Return where the probability is over a half."""
        grid = np.asarray(self.grids[row], np.float32)
        scale, offset = self.fit.scale, np.array(self.fit.offset_px, np.float64)
        if grid.shape[::-1] != self.fit.network_px:
            low, high = self.corners_px[row].reshape(2, 2).astype(np.float64)
            cells = np.array(grid.shape[::-1]) / np.maximum(high - low, 1e-6)
            scale, offset = scale * cells, (offset - low) * cells
        is_inside: BoolArray = sampled(grid, scale, offset, box_px, size_px) > 0.5
        return is_inside
