"""Numbers of tracks: a point keeps its number for as long as it is followed.

The upper half of a number tells the camera, so that the points of two cameras differ without any talk
between their trackers.
"""

from __future__ import annotations

from zlib import crc32

import numpy as np

from mapstream.streams.arrays import IntArray

_CAMERA_BITS = 0x7FFFFFFF  # 31 of the 32, so that numbers stay positive


def first_number(frame: str) -> int:
    """Return the least number that the tracks of a camera have."""
    return (crc32(frame.encode()) & _CAMERA_BITS) << 32


class TrackNumbers:
    """Gives the tracks of one camera numbers that never come twice."""

    def __init__(self, frame: str) -> None:
        self._next = first_number(frame)

    def take(self, count: int) -> IntArray:
        """Return new numbers (count,), growing."""
        taken = np.arange(self._next, self._next + count, dtype=np.int64)
        self._next += count
        return taken


def carried_on(
    before_ids: IntArray, matches: IntArray, count: int, numbers: TrackNumbers
) -> IntArray:
    """Return the track ids (count,) of keypoints, of which some were matched to those of the image before.

    A keypoint without a match begins a track.

    Args:
        before_ids: (M,) track ids of the keypoints before.
        matches: (K, 2) rows of keypoints before and now; no row comes twice.
        count: Number of keypoints now.
        numbers: Where new tracks get their numbers.
    """
    ids = np.full(count, -1, dtype=np.int64)
    ids[matches[:, 1]] = before_ids[matches[:, 0]]
    is_new = ids < 0
    ids[is_new] = numbers.take(int(is_new.sum()))
    return ids
