"""Upkeep of tracks: how many, how close, and which of two that met goes on.

Numbers: maplab_features' Lucas-Kanade tracker.
"""

from __future__ import annotations

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.features.spread import Spread, apart, spread
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import BoolArray, Float32Array, IntArray


class TrackLimits(OperatorConfig):
    """How many tracks a camera has, and where new ones may begin."""

    max_tracks: PositiveInt = 600
    """So many are followed at a time."""
    min_distance_px: PositiveFloat = 7.0
    """No track begins closer to another."""
    border_px: NonNegativeFloat = 30.0
    """No track begins closer to the edge of the image."""
    merge_distance_px: NonNegativeFloat = 3.0
    """Of two tracks that come closer the older goes on."""


def survivors(px: Float32Array, ages: IntArray, merge_distance_px: float) -> BoolArray:
    """Return which tracks (N,) go on where some have come to the same place: the older, of equals the first.

    Args:
        px: (N, 2) where they are now.
        ages: (N,) for how long each was followed.
        merge_distance_px: What counts as the same place.
    """
    oldest_first = np.argsort(-ages, kind="stable")
    kept = np.zeros(len(px), dtype=bool)
    kept[oldest_first[apart(px[oldest_first], merge_distance_px)]] = True
    return kept


def admitted(
    px: Float32Array,
    scores: Float32Array,
    live_px: Float32Array,
    size_px: tuple[int, int],
    limits: TrackLimits,
) -> IntArray:
    """Return which candidates (N, 2) become tracks beside the live ones (M, 2), the strongest first."""
    wanted = Spread(
        limit=limits.max_tracks,
        min_distance_px=limits.min_distance_px,
        border_px=limits.border_px,
    )
    return spread(px, scores, size_px, wanted, live_px)
