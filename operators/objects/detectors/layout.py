"""What a kind of detector file takes and gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.operators.objects.detectors.candidates import Candidates
from mapstream.operators.objects.detectors.image_fit import FitMode, ImageFit

Outputs = Mapping[str, npt.NDArray[Any]]
Read = Callable[[Outputs, ImageFit, float], Candidates]
"""Of one image's outputs, without a batch, those candidates whose score is at least so high."""


@dataclass(frozen=True, slots=True)
class Layout:
    """How to feed a network, and how to read it."""

    read: Read
    num_classes: int | None = None  # None: the outputs do not tell
    fit: FitMode = "corner"
    is_rgb: bool = True
    pad: float = 114.0  # of 255, around the image
    most: float = 1.0  # what 255 becomes
    keeps_size: bool = False  # images go in as large as they are, where the file allows


@dataclass(frozen=True, slots=True)
class Probe:
    """What a network gave for an empty image, from which its layout is told."""

    outputs: Outputs  # with their batch, if they have one
    size_px: tuple[int, int]  # width and height of the image

    def of_rank(self, rank: int) -> list[str]:
        """Return the outputs with so many axes."""
        return [name for name, array in self.outputs.items() if np.ndim(array) == rank]
