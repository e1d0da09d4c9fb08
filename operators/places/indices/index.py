"""What an index of descriptors is, which ones there are, and how they are kept in a file.

The n-th descriptor that was added is row n of the answers. Distances are bits that differ, or Euclidean.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt
from pydantic import Field, NonNegativeInt, PositiveInt

from mapstream.operators.operator import OperatorConfig
from mapstream.recordings.maps.projections import DescriptorProjection
from mapstream.streams.arrays import Float32Array, IntArray
from mapstream.streams.errors import MapError

Descriptors = npt.NDArray[Any]  # (N, D) uint8: bits, or float32


@dataclass(frozen=True, slots=True, eq=False)
class Neighbours:
    """The nearest descriptors of each query, nearest first; row -1 and distance inf where there are no more."""

    rows: IntArray  # (N, k)
    distances: Float32Array  # (N, k)


class DescriptorIndex(Protocol):
    """Descriptors among which the nearest are found; it grows."""

    def __len__(self) -> int: ...

    def add(self, descriptors: Descriptors) -> None:
        """Take in descriptors (N, D), of the width and type that the index is for."""

    def search(self, descriptors: Descriptors, k: int) -> Neighbours:
        """Return the `k` nearest of each descriptor (N, D)."""

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays from which `restore` makes the same index."""

    def restore(self, state: dict[str, npt.NDArray[Any]]) -> None:
        """Become the index whose state this is; nothing was added before."""


class IndexConfig(OperatorConfig):
    """How the nearest descriptors are found."""

    binary: Literal["multi_index", "exact"] = "multi_index"
    """For descriptors that are bits."""
    numbers: Literal["flann", "hnsw", "exact"] = "hnsw"
    """For descriptors that are numbers."""
    dimensions: PositiveInt = 10
    """Numbers to which the multi-index projects bits; even."""
    words: PositiveInt = 16
    """Cells that the multi-index looks into: more find more and take longer."""
    exact_up_to: NonNegativeInt = 5_000
    """Descriptors below which the multi-index compares all of them."""
    trees: PositiveInt = 4
    """Of FLANN."""
    checks: PositiveInt = 256
    """Leaves that FLANN looks into."""
    links: PositiveInt = 12
    """Of each descriptor in HNSW."""
    ef_construction: PositiveInt = 50
    """Descriptors that HNSW considers where it adds one."""
    ef_search: PositiveInt = 50
    """Descriptors that HNSW considers where it searches one."""
    neighbours: NonNegativeInt = Field(default=0, le=100)
    """Taken of each keypoint; 0: one to eight, by how many descriptors there are."""

    def neighbours_among(self, size: int) -> int:
        """Return how many neighbours to take among so many descriptors (maplab's loop engine)."""
        if self.neighbours:
            return self.neighbours
        return 1 + sum(step for most, step in _MORE_FROM.items() if size >= most)


_MORE_FROM = {10_000: 1, 100_000: 1, 1_000_000: 3, 10_000_000: 2}  # 1, 2, 3, 6, 8 neighbours


def make_index(
    width: int,
    dtype: npt.DTypeLike,
    config: IndexConfig,
    projection: DescriptorProjection | None = None,
) -> DescriptorIndex:
    """Return an empty index for descriptors of one width and type.

    Args:
        width: Numbers in a descriptor; of bits, their bytes.
        dtype: uint8 for bits, float32 for numbers.
        config: Which index, and its options.
        projection: Of the multi-index; without one it is learnt from what is added.

    Raises:
        MapError: If descriptors are neither bits nor float32, or the projection is for others.
    """
    from mapstream.operators.places.indices.faiss_indices import Exact, Hnsw  # noqa: PLC0415
    from mapstream.operators.places.indices.flann import Flann  # noqa: PLC0415
    from mapstream.operators.places.indices.multi_index import MultiIndex  # noqa: PLC0415

    name = np.dtype(dtype).name
    if name not in ("uint8", "float32"):
        raise MapError(f"descriptors are uint8 bits or float32 numbers, not {name}")
    if name == "uint8":
        if config.binary == "exact":
            return Exact(width, name)
        return MultiIndex(width, config, projection)
    if config.numbers == "exact":
        return Exact(width, name)
    return Hnsw(width, config) if config.numbers == "hnsw" else Flann(width, config)


def save_index(index: DescriptorIndex, path: Path) -> None:
    """Write an index to a file of numpy arrays."""
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **index.state())


def load_index(empty: DescriptorIndex, path: Path) -> DescriptorIndex:
    """Fill an empty index, made with the options of the one that was saved, from its file.

    Raises:
        MapError: If the file is none of an index, or of another kind of index.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            empty.restore({name: arrays[name] for name in arrays.files})
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError) as error:
        raise MapError(f"{path}: not an index of this kind ({error}); make it again") from error
    return empty
