"""Which landmarks were seen in one image: two of these are never the same thing.

Source: Cramariuc et al., maplab 2.0, RA-L 2023, section IV-D (unique visibility filter).
"""

from __future__ import annotations

import numpy as np

from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, IntArray


def seen_together(map_: Map, landmarks: IntArray) -> BoolArray:
    """Return which of these landmarks (N,) were seen with which in one image (N, N); each with itself."""
    seen = map_.observations
    place = np.full(len(map_.landmarks) + 1, -1)  # the last is that of no landmark
    place[landmarks] = np.arange(len(landmarks))
    rows = np.flatnonzero(place[seen.landmark] >= 0)
    _, sensors = np.unique(seen.sensor[rows].astype(str), return_inverse=True)
    images = np.stack([seen.vertex[rows], sensors, seen.offset_ns[rows]])
    return shared(
        place[seen.landmark[rows]],
        np.unique(images, axis=1, return_inverse=True)[1],
        len(landmarks),
    )


def shared(members: IntArray, groups: IntArray, num: int) -> BoolArray:
    """Return which of `num` members are in a group with which (num, num); each with itself.

    Args:
        members: Shape (M,), who is in a group.
        groups: Shape (M,), which group that is, from 0.
        num: How many members there are.
    """
    from scipy.sparse import coo_array  # noqa: PLC0415  # takes most of a second to import

    groups = groups.ravel()
    shape = (num, int(groups.max(initial=-1)) + 1)
    is_in = coo_array((np.ones(len(members), np.int64), (members, groups)), shape=shape).tocsr()
    together: BoolArray = (is_in @ is_in.T).toarray() > 0
    np.fill_diagonal(together, val=True)
    return together
