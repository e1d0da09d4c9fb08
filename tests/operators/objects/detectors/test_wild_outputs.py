"""Whatever numbers a network gives, what is read of them is finite, within the image, and of its classes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.operators.objects.detectors import fastest_det, mask_rcnn, yolov8, yolox
from mapstream.operators.objects.detectors.image_fit import ImageFit
from mapstream.operators.objects.detectors.layout import Probe

_SIZE_PX = (64, 64)
_SPECIAL = np.array([np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-40, 100.0, -100.0, 0.0], np.float32)
_ADAPTERS: dict[str, tuple[Any, dict[str, tuple[int, ...]]]] = {
    "yolox": (yolox, {"output": (1, 84, 8)}),
    "yolov8": (yolov8, {"output0": (1, 4 + 3 + 2, 84), "output1": (1, 2, 16, 16)}),
    "fastestdet": (fastest_det, {"758": (1, 8, 4, 4)}),
    "mask_rcnn": (mask_rcnn, {"boxes": (9, 4), "scores": (9,), "masks": (9, 1, 4, 4)}),
}


def wild(shape: tuple[int, ...], rng: np.random.Generator, share: float) -> npt.NDArray[np.float32]:
    values = rng.normal(0.3, 1.0, shape).astype(np.float32)
    return np.where(rng.random(shape) < share, rng.choice(_SPECIAL, shape), values)


@pytest.mark.parametrize("kind", list(_ADAPTERS))
@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.02, 0.5]))
def test_wild_outputs_are_survived(kind: str, seed: int, share: float) -> None:
    adapter, shapes = _ADAPTERS[kind]
    rng = np.random.default_rng(seed)
    outputs: dict[str, npt.NDArray[Any]] = {n: wild(s, rng, share) for n, s in shapes.items()}
    if kind == "mask_rcnn":
        outputs["labels"] = rng.integers(0, 91, 9)
    layout = adapter.layout(Probe(outputs, _SIZE_PX))
    fit = ImageFit.of((100, 50), _SIZE_PX, layout.fit)
    of_image = outputs if kind == "mask_rcnn" else {n: a[0] for n, a in outputs.items()}

    with np.errstate(all="raise", under="ignore"):
        found = layout.read(of_image, fit, 0.2)

    assert len(found.boxes_px) == len(found.scores) == len(found.classes)
    assert (found.scores >= 0.2).all() or kind == "yolox"  # there the box's is at least so high
    assert ((found.boxes_px >= -0.5) & (found.boxes_px <= [99.5, 49.5, 99.5, 49.5])).all()
    for mask in found.masks_of(np.arange(len(found.scores)), (100, 50)):
        assert mask.dtype == bool
