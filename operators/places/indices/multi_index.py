"""An inverted multi-index of binary descriptors: cells by a few numbers, distances inside by all bits.

Descriptors are projected to about ten numbers, whose halves are quantised by a codebook each; the nearest
cells are looked into. maplab compares the projections there; bits are compared faster and tell more.
Sources: Lynen et al., Placeless place-recognition, 3DV 2014; Babenko and Lempitsky, CVPR 2012.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.operators.places.indices.faiss_indices import Cells, Exact
from mapstream.operators.places.indices.index import Descriptors, IndexConfig, Neighbours
from mapstream.operators.places.indices.projection import Projection, learn_projection
from mapstream.recordings.maps.projections import DescriptorProjection
from mapstream.streams.errors import MapError

_PER_CELL = 100  # descriptors
_SAMPLE = 50_000  # descriptors from which the cells are learnt
_GROWTH = 4  # times as many as the cells were learnt from, and they are learnt again
_BLOCK = 50_000  # descriptors that are projected at once


class MultiIndex:
    """Exact while it is small; beyond, cells are learnt from what is in it, and again as it grows."""

    def __init__(
        self, width: int, config: IndexConfig, projection: DescriptorProjection | None = None
    ) -> None:
        self._width, self._config = width, config
        self._all = Exact(width, "uint8")
        if projection is not None and len(projection.mean) != 8 * width:
            found, kind = len(projection.mean), projection.kind
            raise MapError(
                f"the index of {kind} projects {found} bits, and descriptors have {8 * width}"
            )
        self._given = None if projection is None else Projection.learnt(projection)
        self._projection: Projection | None = None
        self._cells: Cells | None = None
        self._num_learnt = 0

    def __len__(self) -> int:
        return len(self._all)

    def add(self, descriptors: Descriptors) -> None:
        first = len(self)
        self._all.add(descriptors)
        if len(self) <= self._config.exact_up_to:
            return
        if self._cells is None or len(self) > _GROWTH * self._num_learnt:
            self._learn()
        else:
            self._put(descriptors, first)

    def search(self, descriptors: Descriptors, k: int) -> Neighbours:
        if self._cells is None or self._projection is None:
            return self._all.search(descriptors, k)
        points = self._projection(descriptors)
        return self._cells.search(points, descriptors, k, self._config.words)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        return {"bits": self._all.descriptors()}

    def restore(self, state: dict[str, npt.NDArray[Any]]) -> None:
        if state["bits"].shape[1:] != (self._width,):
            raise ValueError(f"holds descriptors of {state['bits'].shape[1:]} bytes")
        self.add(state["bits"])

    def _learn(self) -> None:
        stored = self._all.descriptors()
        sample = stored[:: max(len(stored) // _SAMPLE, 1)]
        self._projection = self._given or learn_projection(sample, self._config.dimensions)
        bits = int(np.clip(round(np.log2(len(stored) / _PER_CELL) / 2), 1, 8))
        self._cells = Cells(self._width, self._projection(sample), bits)
        self._num_learnt = len(stored)
        self._put(stored, 0)

    def _put(self, descriptors: Descriptors, first: int) -> None:
        assert self._cells is not None and self._projection is not None  # noqa: PT018, S101  # learnt
        for start in range(0, len(descriptors), _BLOCK):
            block = descriptors[start : start + _BLOCK]
            self._cells.add(self._projection(block), block, first + start)
