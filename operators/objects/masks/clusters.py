"""Pieces of what lies in a box, and which of them is the object: the dominant one, or a nearer one like it."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray

_STEP_M = 0.02  # between neighbours on one surface
_STEP_SHARE = 0.02  # the same, of their depth
_RIVAL = 0.6  # of the weight of the heaviest piece; a nearer one with as much is the object
_SLACK = 0.25  # of its size: so far before or behind it other pieces are of the object, too
_MAX_LINKED = 800  # points of a cloud
_SPECK = 0.02  # of the weight of the object; smaller pieces are noise


def pieces_of_depth(depth_m: Float32Array) -> IntArray:
    """Return the number (h, w) of the piece that each pixel is of, from 1; 0 where depth (h, w) is unknown (NaN).

    Pixels side by side are of one piece if the surface goes on from one to the other.
    """
    known = np.isfinite(depth_m)
    z = np.where(known, depth_m, -np.inf)
    number = np.arange(depth_m.size).reshape(depth_m.shape)
    links = []
    for a, b in (np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:]):
        with np.errstate(invalid="ignore"):  # unknown beside unknown
            step_m = np.abs(z[a] - z[b])
            goes_on = step_m < _STEP_M + _STEP_SHARE * np.minimum(z[a], z[b])
        links.append(np.stack([number[a][goes_on], number[b][goes_on]], axis=1))
    labels = _connected(np.concatenate(links), depth_m.size).reshape(depth_m.shape)
    return np.where(known, labels + 1, 0)


def pieces_of_points(points: FloatArray, reach_m: FloatArray) -> IntArray:
    """Return the number (N,) of the piece that each point (N, 3) is of, from 1; points in reach (N,) are of one.

    Of many points some that are evenly spread over their order are linked; the others follow the nearest of these.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  # takes long to import

    if not len(points):
        return np.zeros(0, np.int64)
    few = np.linspace(0, len(points) - 1, min(len(points), _MAX_LINKED)).round().astype(np.int64)
    tree, reach_m = cKDTree(points[few]), reach_m[few]
    pairs = tree.query_pairs(float(reach_m.max()), output_type="ndarray")
    apart_m = np.linalg.norm(points[few[pairs[:, 0]]] - points[few[pairs[:, 1]]], axis=1)
    is_near = apart_m <= np.minimum(reach_m[pairs[:, 0]], reach_m[pairs[:, 1]])
    labels = _connected(pairs[is_near], len(few)) + 1
    nearest: IntArray = tree.query(points)[1]
    return labels[nearest]


def dominant(
    pieces: IntArray, weights: FloatArray, depth_m: FloatArray, size_m: float
) -> BoolArray:
    """Return which elements (N,) are of the object.

    Args:
        pieces: Shape (N,), from 1; 0 is no piece.
        weights: Shape (N,), how much each element counts.
        depth_m: Shape (N,).
        size_m: How large an object in this box is at a depth of 1 m.
    """
    total = np.bincount(pieces, weights)
    total[0] = 0
    if not total.max(initial=0) > 0:
        return np.zeros(len(pieces), np.bool_)
    rivals = np.flatnonzero(total >= _RIVAL * total.max()).tolist()
    chosen = min(rivals, key=lambda n: float(np.median(depth_m[pieces == n])))
    near_m, middle_m, far_m = np.percentile(depth_m[pieces == chosen], [5, 50, 95])
    slack_m = _SLACK * size_m * middle_m
    large = np.flatnonzero(total >= _SPECK * total[chosen]).tolist()
    medians = {n: np.median(depth_m[pieces == n]) for n in large}
    own = [n for n, at_m in medians.items() if near_m - slack_m <= at_m <= far_m + slack_m]
    is_object: BoolArray = np.isin(pieces, own)
    return is_object


def _connected(links: IntArray, num: int) -> IntArray:
    from scipy.sparse import coo_array  # noqa: PLC0415
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    ones = np.ones(len(links), np.bool_)
    graph = coo_array((ones, (links[:, 0], links[:, 1])), shape=(num, num))
    labels: IntArray = connected_components(graph, directed=False)[1].astype(np.int64)
    return labels
