"""Which keypoints of the next image may match: those in a window around where each is expected."""

from __future__ import annotations

import numpy as np
from pydantic import PositiveFloat

from mapstream.operators.tracking.descriptor_matching import (
    MatchRules,
    allowed,
    differences,
    one_to_one,
)
from mapstream.streams.arrays import Float32Array, IntArray
from mapstream.streams.messages.vision import ImageFeatures


class WindowRules(MatchRules):
    """How far from its prediction a keypoint is looked for."""

    window_px: PositiveFloat = 10.0
    """Radius in which is looked first."""
    large_window_px: PositiveFloat = 20.0
    """Where nothing alike is in the first one."""


def matched_near(
    before: ImageFeatures, now: ImageFeatures, expected_px: Float32Array, rules: WindowRules
) -> IntArray:
    """Return matches (K, 2): rows of keypoints before and now.

    Args:
        before: Keypoints of an image.
        now: Keypoints of the next one.
        expected_px: (M, 2) where those of the former are expected in the latter.
        rules: Windows, and when two match.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  # heavy, and most runs have no images

    if len(before) == 0 or len(now) == 0:
        return np.empty((0, 2), dtype=np.int64)
    near = cKDTree(expected_px).sparse_distance_matrix(
        cKDTree(now.keypoints_px), rules.large_window_px, output_type="ndarray"
    )
    pairs = np.stack([near["i"], near["j"]], axis=1).astype(np.int64)
    difference = differences(before.descriptors, now.descriptors, pairs)
    is_close = near["v"] <= rules.window_px
    is_alike = difference <= allowed(rules.min_similarity, before.descriptors)
    found_close = np.unique(pairs[is_close & is_alike, 0])
    wanted = is_close | ~np.isin(pairs[:, 0], found_close)
    return one_to_one(pairs[wanted], difference[wanted], rules, before.descriptors)
