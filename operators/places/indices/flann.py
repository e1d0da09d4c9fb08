"""FLANN's randomised trees for descriptors that are numbers, made able to grow.

Trees cannot grow, so there are several: whenever the newest is half as large as the one before, the two become
one, so that a descriptor is built into a tree some log(N) times (Bentley and Saxe, 1980).
Source: Muja and Lowe, Scalable nearest neighbor algorithms for high dimensional data, PAMI 2014.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.operators.places.indices.index import Descriptors, IndexConfig, Neighbours
from mapstream.streams.arrays import Float32Array

_KD_TREES = 1  # FLANN_INDEX_KDTREE
_SEED = 1


class Flann:
    """Forests of trees over ranges of the descriptors, in order."""

    def __init__(self, width: int, config: IndexConfig) -> None:
        self._width, self._config = width, config
        self._parts: list[Float32Array] = []
        self._trees: list[Any] = []

    def __len__(self) -> int:
        return sum(map(len, self._parts))

    def add(self, descriptors: Descriptors) -> None:
        if not len(descriptors):
            return
        part = np.ascontiguousarray(descriptors, np.float32)
        while self._parts and 2 * len(part) >= len(self._parts[-1]):
            self._trees.pop()
            part = np.concatenate([self._parts.pop(), part])
        self._parts.append(part)
        cv2.setRNGSeed(_SEED)  # the trees are random
        options: dict[str, bool | int | float | str] = {
            "algorithm": _KD_TREES,
            "trees": self._config.trees,
        }
        self._trees.append(cv2.flann.Index(part, options))

    def search(self, descriptors: Descriptors, k: int) -> Neighbours:
        queries = np.ascontiguousarray(descriptors, np.float32)
        rows = [np.full((len(queries), k), -1)]
        distances = [np.full((len(queries), k), np.inf, np.float32)]
        first = 0
        for part, trees in zip(self._parts, self._trees, strict=True):
            if len(queries):
                num = min(k, len(part))
                found, squares = trees.knnSearch(
                    queries, num, params={"checks": self._config.checks}
                )
                rows.append(found.astype(np.int64) + first)
                distances.append(np.sqrt(squares))
            first += len(part)
        all_rows, all_distances = np.concatenate(rows, axis=1), np.concatenate(distances, axis=1)
        best = np.argsort(all_distances, axis=1, kind="stable")[:, :k]
        return Neighbours(
            np.take_along_axis(all_rows, best, axis=1),
            np.take_along_axis(all_distances, best, axis=1),
        )

    def state(self) -> dict[str, npt.NDArray[Any]]:
        ends = np.cumsum([len(part) for part in self._parts])
        empty = np.empty((0, self._width), np.float32)
        return {"numbers": np.concatenate([empty, *self._parts]), "ends": ends.astype(np.int64)}

    def restore(self, state: dict[str, npt.NDArray[Any]]) -> None:
        if state["numbers"].shape[1:] != (self._width,):
            raise ValueError(f"holds descriptors of {state['numbers'].shape[1:]} numbers")
        for part in np.split(state["numbers"], state["ends"][:-1]):
            self.add(part)
