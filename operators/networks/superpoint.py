"""SuperPoint's keypoints (DeTone et al., SuperPoint: Self-Supervised Interest Point Detection, CVPRW 2018).

Its weights may be used for research only, so they come as a file of the user's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import NonNegativeFloat

from mapstream.operators.features.gray import GrayImage
from mapstream.operators.features.spread import apart
from mapstream.operators.networks.keypoints import (
    FittedImage,
    KeypointNetwork,
    Keypoints,
    in_cells,
)
from mapstream.operators.networks.learned_features import LearnedConfig, LearnedFeatures
from mapstream.operators.networks.sessions import Session
from mapstream.operators.networks.xfeat import XFeatKeypoints
from mapstream.operators.operator import OptionalPath
from mapstream.streams.errors import ConfigError, OperatorError

_CELL_PX = 8
_OUTPUTS = (("keypoint", "kpt"), ("score",), ("desc",))  # parts of their names


class SuperPointConfig(LearnedConfig):
    """Options of `superpoint`; the numbers are maplab's."""

    model: OptionalPath = None
    """An ONNX file; without one, XFeat's keypoints, of kind xfeat."""
    kind: str = "superpoint"
    """What the features are called, for files of another network with the same ends."""
    min_score: NonNegativeFloat = 0.005
    min_distance_px: NonNegativeFloat = 4.0
    """Between any two keypoints, of which the better stays."""
    border_px: NonNegativeFloat = 4.0
    """Closer to the edge of the image there are none."""


class SuperPoint(LearnedFeatures):
    """Find keypoints with a network in an ONNX file.

    Its input is an image (1, 1, H, W), 0 to 1.
    Its outputs are keypoints (N, 2) x, y [px], scores (N,) and descriptors (N, D) or (D, N), told apart by their
    names; each may have a first axis of 1 more.
    """

    def __init__(self, config: SuperPointConfig) -> None:
        super().__init__(config)
        self._config = config

    def open(self) -> KeypointNetwork:
        if self._config.model is None:
            return XFeatKeypoints(self._config)
        return SuperPointKeypoints(self._config.model, self._config)


class SuperPointKeypoints:
    """A file with SuperPoint, or with any network that has its ends.

    Raises:
        ConfigError: If the file is no such network.
    """

    def __init__(self, file: Path, options: SuperPointConfig) -> None:
        self.kind = options.kind
        self._options = options
        self._session = Session(file, options.kind)
        inputs = self._session.inputs
        if [len(shape) for shape in inputs.values()] != [4]:
            raise ConfigError(f"{file}: expected one input, an image (1, 1, H, W), found {inputs}")
        self._input, shape = next(iter(inputs.items()))
        self._sides = shape[2:]
        self._outputs = [_output(file, self._session, part) for part in _OUTPUTS]

    def find(self, image: GrayImage) -> Keypoints:
        """Return the keypoints of an image (H, W)."""
        height, width = (
            side if isinstance(side, int) else in_cells(n * self._options.image_scale, _CELL_PX)
            for side, n in zip(self._sides, image.shape, strict=True)
        )
        fitted = FittedImage.of(image, (width, height))
        found = self._session.run({self._input: fitted.image[None, None] / 255})
        px, scores, descriptors = (found[name] for name in self._outputs)
        px, scores = px.reshape(-1, 2), scores.reshape(-1).astype(np.float32)
        descriptors = self._rows(descriptors, len(px))
        rows = self._best(px.astype(np.float32), scores, (width, height))
        chosen = descriptors[rows].astype(np.float32)
        lengths = np.linalg.norm(chosen, axis=1, keepdims=True)
        return Keypoints(
            px=fitted.places(px[rows]),
            scores=scores[rows],
            descriptors=chosen / np.maximum(lengths, np.float32(1e-12)),
        )

    def _best(
        self, px: npt.NDArray[Any], scores: npt.NDArray[Any], size_px: tuple[int, int]
    ) -> npt.NDArray[Any]:
        """Return the rows to keep, the best first; not every file suppresses neighbours itself."""
        options = self._options
        high = np.array(size_px) - 1 - options.border_px
        is_inside = ((px >= options.border_px) & (px <= high)).all(axis=1)
        rows = np.flatnonzero(is_inside & (scores >= options.min_score))
        rows = rows[np.argsort(-scores[rows], kind="stable")]
        return rows[apart(px[rows], options.min_distance_px)][: options.max_features]

    def _rows(self, descriptors: npt.NDArray[Any], count: int) -> npt.NDArray[Any]:
        """Return descriptors one per row."""
        width = self._session.outputs[self._outputs[2]][-1]
        flat = descriptors.reshape(-1, descriptors.shape[-1])
        is_turned = len(flat) != count or (not isinstance(width, int) and flat.shape[1] == count)
        rows = flat.T if is_turned else flat
        if len(rows) != count:
            raise OperatorError(
                f"{self.kind}: {count} keypoints with descriptors of shape {descriptors.shape}"
            )
        return rows


def _output(file: Path, session: Session, parts: tuple[str, ...]) -> str:
    """Return the output whose name tells what it is."""
    names = [name for name in session.outputs if any(part in name.lower() for part in parts)]
    if len(names) != 1:
        found = sorted(session.outputs)
        raise ConfigError(
            f"{file}: expected one output with {parts[0]!r} in its name, found {found}"
        )
    return names[0]
