"""An array of whole numbers that grows at its end, in little time."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import IntArray


class Growing:
    """Room is doubled whenever it runs out."""

    def __init__(self) -> None:
        self._room: IntArray = np.empty(64, np.int64)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def values(self) -> IntArray:
        return self._room[: self._size]

    def extend(self, values: IntArray) -> None:
        size = self._size + len(values)
        if size > len(self._room):
            self._room = np.concatenate([self.values, np.empty(2 * size, np.int64)])
        self._room[self._size : size] = values
        self._size = size
