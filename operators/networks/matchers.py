"""Networks that match the keypoints of two images, each behind one call.

LightGlue: Lindenberger et al., ICCV 2023. SuperGlue: Sarlin et al., CVPR 2020, whose weights may be used for
research only, so they come as a file of the user's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from mapstream.operators.networks.installed import weights_of
from mapstream.operators.networks.lightglue_network import lighterglue_model
from mapstream.operators.networks.sessions import Session
from mapstream.streams.arrays import Float32Array, IntArray
from mapstream.streams.errors import ConfigError, OperatorError
from mapstream.streams.messages.vision import ImageFeatures

NO_MATCHES = np.empty((0, 2), np.int64)
_LIGHTGLUE = ("kpts", "desc")  # inputs, each once for either image
_SUPERGLUE = ("keypoints", "scores", "descriptors")
_SCORES = ("mscores0", "matching_scores0")


class Matcher(Protocol):
    """Says which keypoints of two images are of the same points."""

    def match(self, first: ImageFeatures, second: ImageFeatures) -> IntArray:
        """Return pairs of rows (K, 2), none of which comes twice."""
        ...


def make_matcher(model: str, min_score: float) -> Matcher:
    """Return a matcher that is installed, or in a file.

    Raises:
        ConfigError: If it is not installed, or the file is no network that matches.
    """
    if model == "lighterglue":
        session = Session(lighterglue_model(weights_of("lighterglue")), "lighterglue")
        return NetworkMatcher(session, min_score)
    file = Path(model)
    if not file.suffix:
        raise ConfigError(f"no matcher {model!r}; expected lighterglue, or an ONNX file")
    return NetworkMatcher(Session(file, file.name), min_score)


class NetworkMatcher:
    """LightGlue or SuperGlue, whichever the inputs of the network tell.

    LightGlue takes kpts0, kpts1 (1, N, 2) and desc0, desc1 (1, N, D); SuperGlue takes keypoints0, keypoints1,
    scores0, scores1 (1, N) and descriptors0, descriptors1 (1, D, N). Keypoints are in [-1, 1] along the longer side.
    Either gives matches0: for each keypoint of the first image the row in the second, -1 without one,
    or pairs (K, 2); and its scores, named mscores0 or matching_scores0.

    Args:
        session: The network.
        min_score: Less sure pairs are no match.

    Raises:
        ConfigError: If it has other inputs or outputs.
    """

    def __init__(self, session: Session, min_score: float) -> None:
        self._session = session
        self._min_score = min_score
        self._is_superglue = "keypoints0" in session.inputs
        wanted = _SUPERGLUE if self._is_superglue else _LIGHTGLUE
        missing = sorted({f"{name}{i}" for name in wanted for i in (0, 1)} ^ set(session.inputs))
        scores = [name for name in _SCORES if name in session.outputs]
        if missing or not scores or "matches0" not in session.outputs:
            raise ConfigError(
                f"{session.name}: no network that matches keypoints; it takes "
                f"{sorted(session.inputs)} and gives {sorted(session.outputs)}"
            )
        self._scores = scores[0]

    def match(self, first: ImageFeatures, second: ImageFeatures) -> IntArray:
        """Return pairs of rows (K, 2), none of which comes twice.

        Raises:
            OperatorError: If the network cannot be run on these features.
        """
        if not (len(first) and len(second)):
            return NO_MATCHES
        found = self._session.run(self._feeds(first, 0) | self._feeds(second, 1))
        matches, scores = found["matches0"], found[self._scores].reshape(-1)
        if matches.shape[-1] == 2 and matches.size == 2 * len(scores):
            pairs = matches.reshape(-1, 2).astype(np.int64)
        else:
            to = matches.reshape(-1).astype(np.int64)
            pairs = np.column_stack([np.arange(len(to)), to])
        return one_to_one(pairs, np.where(pairs[:, 1] >= 0, scores, -1), self._min_score)

    def _feeds(self, features: ImageFeatures, i: int) -> dict[str, npt.NDArray[Any]]:
        px = normalized_px(features)[None]
        if self._is_superglue:
            scores = features.scores
            if scores is None:
                raise OperatorError(
                    f"{self._session.name}: features of {features.kind} have no scores"
                )
            turned = features.descriptors.T[None]
            return {f"keypoints{i}": px, f"scores{i}": scores[None], f"descriptors{i}": turned}
        return {f"kpts{i}": px, f"desc{i}": features.descriptors[None]}


def normalized_px(features: ImageFeatures) -> Float32Array:
    """Return keypoints (N, 2) from the middle of the image, in halves of its longer side.

    Without a calibration the image is taken to end at the outermost keypoints.
    """
    px = features.keypoints_px
    if features.camera is None:
        size = px.max(axis=0, initial=0) + 1
    else:
        size = np.array([features.camera.width_px, features.camera.height_px], np.float32)
    normalized: Float32Array = ((px - size / 2) / (size.max() / 2)).astype(np.float32)
    return normalized


def one_to_one(pairs: IntArray, scores: npt.NDArray[Any], min_score: float) -> IntArray:
    """Return the pairs (K, 2) that are sure enough; of those that share a row the surest."""
    order = np.argsort(-scores, kind="stable")
    order = order[scores[order] > min_score]
    for side in (0, 1):
        _, first = np.unique(pairs[order, side], return_index=True)
        order = order[np.sort(first)]
    kept: IntArray = pairs[np.sort(order)]
    return kept
