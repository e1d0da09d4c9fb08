"""What an object looked like when it was seen."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import Float32Array


class Gallery:
    """The last descriptors of one object.

    Source: Wojke et al., ICIP 2017, section 2.2: the smallest cosine distance to any of the last 100.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._rows: Float32Array = np.empty((0, 0), np.float32)
        self._count = 0  # of all that ever came

    def add(self, descriptor: Float32Array) -> None:
        """Keep a descriptor (D,) of unit length in the place of the oldest; one that is not known is passed over."""
        if not np.isfinite(descriptor[0]):
            return
        at = self._count % self._size
        if at >= len(self._rows):
            room = np.empty((min(2 * at + 4, self._size), len(descriptor)), np.float32)
            room[:at] = self._rows.reshape(at, len(descriptor))
            self._rows = room
        self._rows[at] = descriptor
        self._count += 1

    def last_distance(self, descriptor: Float32Array) -> float:
        """Return the cosine distance of a descriptor (D,) from the newest; infinite where there is none."""
        if self._count == 0:
            return np.inf
        return 1 - float(descriptor @ self._rows[(self._count - 1) % self._size])

    def distances(self, descriptors: Float32Array) -> Float32Array:
        """Return the smallest cosine distance of each descriptor (N, D); NaN where one side has none."""
        kept = self._rows[: self._count]
        if len(kept) == 0:
            return np.full(len(descriptors), np.nan, np.float32)
        distances: Float32Array = 1 - (descriptors @ kept.T).max(axis=1)
        return distances
