"""Which tracks of the window are used at an image."""

from __future__ import annotations

import numpy as np

from mapstream.operators.odometry.visual.sightings import Sightings
from mapstream.streams.arrays import IntArray

_LEAST_VIEWS = 3  # of a track that is used


def complete(
    sightings: Sightings, keys_now: IntArray, oldest_id: int | None, most: int
) -> tuple[IntArray, IntArray]:
    """Return the keys of tracks whose time has come, and of those that will not be needed any more.

    A track's time has come when its point is lost, or when it reaches back to the oldest clone of a full window.
    If those are too many the longest are used; of the others those that go on wait for the next image.

    Args:
        sightings: Of the window.
        keys_now: Points that are seen now.
        oldest_id: Of a full window; None if it is not full.
        most: So many are used.
    """
    keys, point, counts = np.unique(sightings.keys, return_inverse=True, return_counts=True)
    is_lost = ~np.isin(keys, keys_now)
    is_due = is_lost.copy()
    if oldest_id is not None:
        is_due[point[sightings.images == oldest_id]] = True
    due = np.flatnonzero(is_due & (counts >= _LEAST_VIEWS))
    used = due[np.lexsort((keys[due], -counts[due]))[:most]]
    return keys[used], np.union1d(keys[used], keys[is_lost])
