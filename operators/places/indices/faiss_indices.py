"""Indices of faiss, which only this module imports: exact search, small worlds, cells and lists of bits.

Sources: Douze et al., The Faiss library, 2024; Malkov and Yashunin, Efficient and robust approximate nearest neighbor
search using hierarchical navigable small world graphs, PAMI 2020.
"""

from __future__ import annotations

from typing import Any

import faiss as _faiss
import numpy as np
import numpy.typing as npt

from mapstream.operators.places.indices.index import Descriptors, IndexConfig, Neighbours
from mapstream.streams.arrays import Float32Array, IntArray

faiss: Any = _faiss  # its stubs do not know what it adds to its classes
faiss.omp_set_num_threads(1)  # the graph places operators on cores, and sums repeat


class Exact:
    """Compares with all of them."""

    def __init__(self, width: int, dtype: str) -> None:
        self._is_binary = dtype == "uint8"
        self._index = (
            faiss.IndexBinaryFlat(8 * width) if self._is_binary else faiss.IndexFlatL2(width)
        )

    def __len__(self) -> int:
        return int(self._index.ntotal)

    def add(self, descriptors: Descriptors) -> None:
        self._index.add(np.ascontiguousarray(descriptors))

    def search(self, descriptors: Descriptors, k: int) -> Neighbours:
        return neighbours(
            *self._index.search(np.ascontiguousarray(descriptors), k), is_binary=self._is_binary
        )

    def state(self) -> dict[str, npt.NDArray[Any]]:
        return {"descriptors": self.descriptors()}

    def restore(self, state: dict[str, npt.NDArray[Any]]) -> None:
        self.add(state["descriptors"])

    def descriptors(self) -> Descriptors:
        """Return all of them (N, D), in the order in which they came."""
        flat = faiss.vector_to_array(self._index.xb if self._is_binary else self._index.codes)
        width = self._index.code_size if self._is_binary else self._index.d
        dtype = np.uint8 if self._is_binary else np.float32
        stored: Descriptors = flat.view(dtype).reshape(-1, width)
        return stored


class Hnsw:
    """A small world of descriptors, each linked to some that are near (for numbers)."""

    def __init__(self, width: int, config: IndexConfig) -> None:
        self._config = config
        self._index = faiss.IndexHNSWFlat(width, config.links)
        self._index.hnsw.efConstruction = config.ef_construction
        self._index.hnsw.efSearch = config.ef_search

    def __len__(self) -> int:
        return int(self._index.ntotal)

    def add(self, descriptors: Descriptors) -> None:
        self._index.add(np.ascontiguousarray(descriptors, np.float32))

    def search(self, descriptors: Descriptors, k: int) -> Neighbours:
        self._index.hnsw.efSearch = max(self._config.ef_search, k)
        found = self._index.search(np.ascontiguousarray(descriptors, np.float32), k)
        return neighbours(*found, is_binary=False)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        return {"hnsw": faiss.serialize_index(self._index)}

    def restore(self, state: dict[str, npt.NDArray[Any]]) -> None:
        try:
            index = faiss.deserialize_index(state["hnsw"])
        except RuntimeError as error:  # faiss has no other
            raise ValueError(f"damaged: {error}") from error
        if not isinstance(index, faiss.IndexHNSWFlat) or index.d != self._index.d:
            raise ValueError(f"holds {type(index).__name__} of width {index.d}")
        self._index = index


class Cells:
    """Bits in lists by cell, whose cells a product of two codebooks names: the inverted multi-index.

    Source: Babenko and Lempitsky, The inverted multi-index, CVPR 2012.
    """

    def __init__(self, bytes_: int, sample: Float32Array, bits_per_half: int) -> None:
        self._quantizer = faiss.MultiIndexQuantizer(sample.shape[1], 2, bits_per_half)
        self._quantizer.train(np.ascontiguousarray(sample))
        self._unused = faiss.IndexBinaryFlat(8 * bytes_)  # the lists want a quantizer of bits
        self._num_cells = 4**bits_per_half
        self._lists = faiss.IndexBinaryIVF(self._unused, 8 * bytes_, self._num_cells)
        self._lists.is_trained = True

    def add(self, points: Float32Array, descriptors: Descriptors, first_row: int) -> None:
        """Put descriptors (N, D) into the cells of their projections (N, d); rows count on from the first."""
        cells = self._quantizer.search(np.ascontiguousarray(points), 1)[1][:, 0].copy()
        codes = np.ascontiguousarray(descriptors)
        rows: IntArray = np.arange(first_row, first_row + len(codes), dtype=np.int64)
        pointers = [faiss.swig_ptr(array) for array in (codes, rows, cells)]
        self._lists.add_core(len(codes), *pointers)

    def search(
        self, points: Float32Array, descriptors: Descriptors, k: int, words: int
    ) -> Neighbours:
        """Return the nearest by bits, among those in the cells nearest to the projections."""
        self._lists.nprobe = min(words, self._num_cells)
        cells = self._quantizer.search(np.ascontiguousarray(points), self._lists.nprobe)[1]
        found = self._lists.search_preassigned(np.ascontiguousarray(descriptors), k, cells, None)
        return neighbours(*found, is_binary=True)


def neighbours(distances: npt.NDArray[Any], rows: IntArray, *, is_binary: bool) -> Neighbours:
    """Return what faiss found: distances as they are for bits, the roots of the squares for numbers."""
    lengths = distances.astype(np.float32)
    if not is_binary:
        lengths = np.sqrt(np.maximum(lengths, 0))
    return Neighbours(rows, np.where(rows < 0, np.float32(np.inf), lengths))
