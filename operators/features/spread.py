"""Which keypoints to keep: the strongest, none too close to another, not all in one corner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import BoolArray, Float32Array, IntArray

_NO_POINTS = np.empty((0, 2), np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Spread:
    """How many keypoints an image may have, and how they lie in it."""

    limit: int
    min_distance_px: float
    border_px: float = 0.0
    columns: int = 4
    rows: int = 2
    cell_share: float = 2.0
    """A cell of the grid may hold so many times its even share of the limit."""


def spread(
    px: Float32Array,
    scores: Float32Array,
    size_px: tuple[int, int],
    wanted: Spread,
    live_px: Float32Array | None = None,
) -> IntArray:
    """Return which of the points (N, 2) to keep, the strongest first.

    Args:
        px: Candidates.
        scores: (N,) the higher, the better; of equals the first wins.
        size_px: Width and height of the image.
        wanted: The limits; they hold for what is returned and the live points together.
        live_px: (M, 2) points that are there already and stay.
    """
    live_px = _NO_POINTS if live_px is None else live_px
    low, high = wanted.border_px, np.array(size_px) - 1 - wanted.border_px
    is_inside = ((px >= low) & (px <= high)).all(axis=1)
    order = np.flatnonzero(is_inside)
    order = order[np.argsort(-scores[order], kind="stable")]
    order = order[apart(px[order], wanted.min_distance_px, live_px)]
    cell_limit = int(np.ceil(wanted.cell_share * wanted.limit / (wanted.columns * wanted.rows)))
    cells = _cells(np.concatenate([live_px, px[order]]), size_px, wanted)
    order = order[_rank_in_cell(cells)[len(live_px) :] < cell_limit]
    kept: IntArray = order[: max(0, wanted.limit - len(live_px))]
    return kept


def apart(px: Float32Array, distance_px: float, live_px: Float32Array | None = None) -> BoolArray:
    """Return which points (N, 2) to keep, if each removes those behind it that are within a distance.

    Live points (M, 2) come before all others, and stay.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  # heavy, and most runs have no images

    live_px = _NO_POINTS if live_px is None else live_px
    num_live = len(live_px)
    all_px = np.concatenate([live_px, px])
    kept = np.ones(len(all_px), dtype=bool)
    pairs = np.empty((0, 2), np.int64)  # the stronger first
    if len(all_px) > 1 and distance_px > 0:
        pairs = cKDTree(all_px).query_pairs(distance_px, output_type="ndarray")
        pairs = pairs[pairs[:, 1] >= num_live]
    while len(pairs):  # points that none stronger threatens any more remove their neighbours
        is_safe = kept.copy()
        is_safe[pairs[:, 1]] = False
        kept[pairs[is_safe[pairs[:, 0]], 1]] = False
        pairs = pairs[~is_safe[pairs[:, 0]] & kept[pairs].all(axis=1)]
    return kept[num_live:]


def _cells(px: Float32Array, size_px: tuple[int, int], wanted: Spread) -> IntArray:
    """Return the number of the grid's cell that each point lies in."""
    grid = np.array([wanted.columns, wanted.rows])
    column_row = np.clip((px * grid / np.array(size_px)).astype(np.int64), 0, grid - 1)
    cells: IntArray = column_row[:, 1] * wanted.columns + column_row[:, 0]
    return cells


def _rank_in_cell(cells: IntArray) -> IntArray:
    """Return how many points of the same cell come before each point."""
    by_cell = np.argsort(cells, kind="stable")
    ordered = cells[by_cell]
    first = np.searchsorted(ordered, ordered)
    ranks = np.empty_like(cells)
    ranks[by_cell] = np.arange(len(cells)) - first
    return ranks
