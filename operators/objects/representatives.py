"""Which few of many descriptors of one object stand for all: the medoids of as many clusters as they have.

Sources: Kaufman and Rousseeuw, Finding Groups in Data, 1990, chapter 2 (PAM: BUILD and SWAP); Schubert and Rousseeuw,
Faster k-Medoids Clustering, SISAP 2019 (all swaps judged at once); Rousseeuw, Silhouettes, J. Comput. Appl. Math. 1987.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import Float32Array, FloatArray, IntArray

_MOST_ROWS = 300  # that are compared with each other
_MOST_SWAPS = 100
_TINY = 1e-9


def representatives(
    descriptors: npt.NDArray[np.floating], *, max_count: int = 8, min_silhouette: float = 0.15
) -> IntArray:
    """Return the rows (K,) of descriptors that stand for all of them, in order; at least one if there is any.

    Of more than 300, as many evenly spread ones are looked at.

    Args:
        descriptors: (N, D) of unit length; rows that are NaN or zeros say nothing and are left out.
        max_count: Most rows to return.
        min_silhouette: A division that is worse is none: one descriptor stands for all then. That of chance is
            at most 0.1 for descriptors of 64 numbers or more.
    """
    usable = np.flatnonzero(np.isfinite(descriptors).all(axis=1) & descriptors.any(axis=1))
    if len(usable) > _MOST_ROWS:
        usable = usable[np.linspace(0, len(usable) - 1, _MOST_ROWS).round().astype(np.int64)]
    if len(usable) == 0:
        return usable
    distances = distances_between(descriptors[usable].astype(np.float32))
    begun = _built(distances, min(max_count, len(usable) - 1))
    best, best_silhouette = begun[:1], min_silhouette
    for count in range(2, len(begun) + 1):
        medoids = _swapped(distances, begun[:count])
        silhouette = mean_silhouette(distances, distances[:, medoids].argmin(axis=1))
        if silhouette > best_silhouette:
            best, best_silhouette = medoids, silhouette
    return np.sort(usable[best])


def distances_between(descriptors: Float32Array) -> FloatArray:
    """Return the Euclidean distances (N, N) of descriptors (N, D) of unit length."""
    cosines = descriptors.astype(np.float64) @ descriptors.T.astype(np.float64)
    distances: FloatArray = np.sqrt(np.maximum(2 - 2 * cosines, 0))
    np.fill_diagonal(distances, 0)
    return distances


def mean_silhouette(distances: FloatArray, clusters: IntArray) -> float:
    """Return how well clusters (N,) divide what is so far apart (N, N): 1 very well, 0 not at all.

    What is alone in its cluster counts as 0, as does one cluster of all.
    """
    members = clusters[:, None] == np.unique(clusters)
    if members.shape[1] == 1:
        return 0.0
    sizes, rows = members.sum(axis=0), np.arange(len(clusters))
    own = members.argmax(axis=1)
    sums = distances @ members.astype(np.float64)
    within = sums[rows, own] / np.maximum(sizes[own] - 1, 1)
    beyond = np.where(members, np.inf, sums / sizes).min(axis=1)
    widths = np.where(
        sizes[own] > 1, (beyond - within) / np.maximum(np.maximum(beyond, within), _TINY), 0
    )
    return float(widths.mean())


def _built(distances: FloatArray, count: int) -> IntArray:
    """Return medoids (count,), at least one, each chosen as the best addition to those before it."""
    medoids = [int(distances.sum(axis=0).argmin())]
    nearest = distances[:, medoids[0]]
    while len(medoids) < count:
        gains = np.maximum(nearest[:, None] - distances, 0).sum(axis=0)
        medoids.append(int(gains.argmax()))
        nearest = np.minimum(nearest, distances[:, medoids[-1]])
    return np.array(medoids)


def _swapped(distances: FloatArray, medoids: IntArray) -> IntArray:
    """Return medoids after each was exchanged for another row as long as that brings all rows nearer to one."""
    medoids = medoids.copy()
    rows, numbers = np.arange(len(distances)), np.arange(len(medoids))
    for _ in range(_MOST_SWAPS):
        to_medoids = distances[:, medoids]
        order = np.argsort(to_medoids, axis=1, kind="stable")
        nearest, second = (to_medoids[rows, order[:, rank]][:, None] for rank in (0, 1))
        gained = np.minimum(distances - nearest, 0).sum(axis=0)  # by a row as one more medoid
        lost = np.minimum(distances, second) - np.minimum(distances, nearest)
        is_own = (order[:, 0] == numbers[:, None]).astype(np.float64)  # (K, N)
        changes = gained + is_own @ lost  # by a row in the place of a medoid (K, N)
        out, in_ = np.unravel_index(changes.argmin(), changes.shape)
        if changes[out, in_] >= -_TINY:
            break
        medoids[out] = in_
    return medoids
