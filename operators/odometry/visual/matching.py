"""Keypoints without tracks, matched by descriptors to the points of the last keyframes.

At a low frame rate a point moves too far to be followed; what it looks like tells it then.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import IntArray
from mapstream.streams.messages.vision import ImageFeatures

_MAX_RATIO = 0.8  # of the distance to the best to that to the second best (Lowe)


@dataclass(slots=True, eq=False)
class _Known:
    ids: IntArray  # (N,)
    descriptors: npt.NDArray[Any]  # (N, D)
    ages: IntArray  # (N,) keyframes since the point was seen last


class DescriptorTracks:
    """Gives keypoints the numbers of points that look like them.

    Args:
        memory: For so many keyframes a point that is not seen is remembered.
    """

    def __init__(self, memory: int) -> None:
        self._memory = memory
        self._known: dict[tuple[str, str], _Known] = {}  # by kind and camera
        self._next = 0

    def numbered(self, features: ImageFeatures) -> ImageFeatures:
        """Return keypoints with the numbers of known points, and new numbers for the others."""
        ids = self._next + np.arange(len(features))
        self._next += len(features)
        known = self._known.get((features.kind, features.frame))
        if known is not None and len(known.ids) > 1 and len(features) > 1:
            mine, theirs = _mutual(features.descriptors, known.descriptors)
            ids[mine] = known.ids[theirs]
        return replace(features, track_ids=ids)

    def remember(self, features: ImageFeatures) -> None:
        """Take the keypoints of a keyframe, numbered, for what later ones are compared with."""
        place = (features.kind, features.frame)
        known = self._known.get(place)
        ids = features.track_ids
        if ids is None:
            return
        if known is None:
            self._known[place] = _Known(
                ids, features.descriptors, np.zeros(len(features), np.int64)
            )
            return
        kept = ~np.isin(known.ids, ids) & (known.ages + 1 < self._memory)
        self._known[place] = _Known(
            np.concatenate([known.ids[kept], ids]),
            np.concatenate([known.descriptors[kept], features.descriptors]),
            np.concatenate([known.ages[kept] + 1, np.zeros(len(features), np.int64)]),
        )


def _mutual(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> tuple[IntArray, IntArray]:
    """Return rows of a and of b that are each other's best, and better than the second best by the ratio."""
    norm = cv2.NORM_HAMMING if a.dtype == np.uint8 else cv2.NORM_L2
    forward = cv2.BFMatcher(norm).knnMatch(a, b, k=2)
    backward = {m.queryIdx: m.trainIdx for m in cv2.BFMatcher(norm).match(b, a)}
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, second in forward
        if best.distance < _MAX_RATIO * second.distance
        and backward.get(best.trainIdx) == best.queryIdx
    ]
    rows = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return rows[:, 0], rows[:, 1]
