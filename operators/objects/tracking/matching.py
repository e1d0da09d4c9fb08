"""Which detection belongs to which track, so that all pairs together cost the least.

Source: Wojke et al., Simple Online and Realtime Tracking with a Deep Association Metric, ICIP 2017, section 2.3.
"""

from __future__ import annotations

import numpy as np

from mapstream.operators.objects.box_areas import intersection_over_union
from mapstream.streams.arrays import FloatArray, IntArray

_NEVER = 1e5  # more than any number of pairs that may be can cost


def assigned(costs: FloatArray) -> IntArray:
    """Return the pairs (K, 2) of rows and columns whose costs (T, N) are least in all; infinite ones never pair."""
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  # heavy

    possible = np.isfinite(costs)
    rows, columns = np.flatnonzero(possible.any(axis=1)), np.flatnonzero(possible.any(axis=0))
    if len(rows) == 0:
        return np.empty((0, 2), np.int64)
    some = np.ix_(rows, columns)
    row, column = linear_sum_assignment(np.where(possible[some], costs[some], _NEVER))
    pairs: IntArray = np.stack([rows[row], columns[column]], axis=1)
    return pairs[possible[pairs[:, 0], pairs[:, 1]]]


def cascaded(costs: FloatArray, seen_ns: IntArray) -> IntArray:
    """Return pairs (K, 2) of tracks and detections; tracks that were seen later choose first.

    A track that was not seen for long expects its object almost anywhere, and would take what others are sure of.

    Args:
        costs: (T, N), infinite for what cannot be.
        seen_ns: (T,) when each track was seen last.
    """
    left = costs.copy()
    pairs = [np.empty((0, 2), np.int64)]
    for stamp_ns in np.unique(seen_ns)[::-1]:
        rows = np.flatnonzero(seen_ns == stamp_ns)
        found = assigned(left[rows])
        found[:, 0] = rows[found[:, 0]]
        left[:, found[:, 1]] = np.inf
        pairs.append(found)
    return np.concatenate(pairs)


def overlaps(a_px: FloatArray, b_px: FloatArray) -> FloatArray:
    """Return the intersection over union (T, N) of boxes (T, 4) and (N, 4), x_min, y_min, x_max, y_max."""
    return intersection_over_union(a_px.T[:, :, None], b_px.T[:, None])
