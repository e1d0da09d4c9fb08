"""Truncated signed distances in blocks of voxels, of which there are only those near to what was seen.

Source: Niessner et al., Real-time 3D reconstruction at scale using voxel hashing, ACM TOG 32(6), 2013;
Oleynikova et al., Voxblox, IROS 2017.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray
from mapstream.streams.errors import MapError

SIDE = 8  # voxels along an edge of a block
VOXELS = SIDE**3  # of a block
_BITS = 17  # of a block's coordinate on each axis
_HALF = 1 << (_BITS - 1)
_FIRST_CAPACITY = 256  # blocks
_BYTES = 8 * VOXELS  # of a block without colours
_BYTES_OF_COLORS = 6 * VOXELS

# Places of the voxels of a block in it, (VOXELS, 3) [voxels], the last axis counting fastest.
PLACES: IntArray = np.stack(np.unravel_index(np.arange(VOXELS), (SIDE,) * 3), axis=1).astype(
    np.int64
)


class TsdfVolume:
    """Distances, weights and colours of voxels; the middle of voxel (i, j, k) is at (i, j, k) + 1/2.

    Rows of the arrays are blocks, in the order in which they were allocated. Voxels of weight 0 were never
    seen. Distances are positive on the side from which a surface was seen, and at most `truncation_m`.
    """

    def __init__(
        self, voxel_size_m: float, truncation_m: float, max_bytes: int, *, has_colors: bool = False
    ) -> None:
        """Make an empty volume.

        Args:
            voxel_size_m: Edge of a voxel.
            truncation_m: Distances beyond it are not told apart.
            max_bytes: What the blocks may take at most.
            has_colors: Whether voxels have colours, too.
        """
        self.voxel_size_m = voxel_size_m
        self.truncation_m = truncation_m
        self.max_bytes = max_bytes
        self._rows: dict[int, int] = {}  # by the number of a block
        self._blocks: IntArray = np.empty((0, 3), np.int64)
        self._distance_m: Float32Array = np.empty((0, VOXELS), np.float32)
        self._weight: Float32Array = np.empty((0, VOXELS), np.float32)
        self._rgb: npt.NDArray[np.float16] | None = (
            np.empty((0, VOXELS, 3), np.float16) if has_colors else None
        )

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def num_bytes(self) -> int:
        """What the blocks that are in use take."""
        return len(self) * self._bytes_of_block

    @property
    def block_size_m(self) -> float:
        return SIDE * self.voxel_size_m

    @property
    def blocks(self) -> IntArray:
        """Return the coordinates (B, 3) of the blocks; block b reaches from `b` to `b + 1` block sizes."""
        return self._blocks[: len(self)]

    @property
    def distance_m(self) -> Float32Array:
        """Return the distances (B, VOXELS) [m], to be written by who integrates."""
        return self._distance_m[: len(self)]

    @property
    def weight(self) -> Float32Array:
        """Return the weights (B, VOXELS), to be written by who integrates."""
        return self._weight[: len(self)]

    @property
    def rgb(self) -> npt.NDArray[np.float16] | None:
        """Return the colours (B, VOXELS, 3), 0 to 255, NaN where no camera saw any, to be written by who integrates."""
        return None if self._rgb is None else self._rgb[: len(self)]

    def drop_colors(self) -> None:
        """Forget the colours, as where no camera saw any."""
        self._rgb = None

    @property
    def _bytes_of_block(self) -> int:
        return _BYTES + (0 if self._rgb is None else _BYTES_OF_COLORS)

    def blocks_at(self, points: npt.NDArray[np.floating]) -> IntArray:
        """Return the blocks (B, 3) in which points (N, 3) [m] lie, each once, in a fixed order.

        Raises:
            MapError: If a point is too far from the origin to have a name.
        """
        keys = np.unique(_keys(np.floor(points * (1 / self.block_size_m)).astype(np.int64)))
        return _blocks_of(keys)

    def allocate(self, blocks: IntArray) -> IntArray:
        """Return the rows (B,) of blocks (B, 3), each of which is there from now on.

        Raises:
            MapError: If they need more memory than is allowed; the volume is as before.
        """
        keys = _keys(blocks).tolist()
        new = [key for key in dict.fromkeys(keys) if key not in self._rows]
        if new:
            self._reserve(len(self) + len(new))
            first = len(self)
            self._rows.update(zip(new, range(first, first + len(new)), strict=True))
            self._blocks[first : first + len(new)] = _blocks_of(np.array(new))
        return np.fromiter((self._rows[key] for key in keys), np.int64, len(keys))

    def rows_of(self, blocks: IntArray) -> IntArray:
        """Return the rows (B,) of blocks (B, 3); -1 of those that are not there."""
        keys = _keys(blocks).tolist()
        return np.fromiter((self._rows.get(key, -1) for key in keys), np.int64, len(keys))

    def middles_m(self, rows: IntArray) -> FloatArray:
        """Return the middles (B, 3) of blocks [m]."""
        middles: FloatArray = (self.blocks[rows] + 0.5) * np.float64(self.block_size_m)
        return middles

    def _reserve(self, num_blocks: int) -> None:
        if num_blocks <= len(self._blocks):
            return
        most = self.max_bytes // self._bytes_of_block
        if num_blocks > most:
            larger_m = self.voxel_size_m * np.sqrt(2 * num_blocks / max(most, 1))
            raise MapError(
                f"the volume needs more than the {self.max_bytes / 1e6:.0f} MB that it may have, with "
                f"{num_blocks} blocks of voxels of {self.voxel_size_m:g} m; use larger voxels "
                f"(voxel_size_m, {larger_m:.2g} for instance), a shorter reach, or more memory (max_bytes)"
            )
        capacity = min(most, max(2 * len(self._blocks), num_blocks, _FIRST_CAPACITY))
        self._blocks = _grown(self._blocks, capacity)
        self._distance_m = _grown(self._distance_m, capacity)
        self._weight = _grown(self._weight, capacity)
        if self._rgb is not None:
            self._rgb = _grown(self._rgb, capacity, np.nan)


def observed(volume: TsdfVolume, min_weight: float) -> BoolArray:
    """Return which voxels (B, VOXELS) were seen well enough."""
    return volume.weight > min_weight


def _grown(array: npt.NDArray[Any], capacity: int, fill: float = 0) -> npt.NDArray[Any]:
    grown = np.full((capacity, *array.shape[1:]), fill, array.dtype)
    grown[: len(array)] = array
    return grown


def _keys(blocks: IntArray) -> IntArray:
    """Return a number (B,) for each block (B, 3)."""
    if len(blocks) and (blocks.min() < -_HALF or blocks.max() >= _HALF):
        reach = _HALF * SIDE
        raise MapError(
            f"what was seen lies beyond {reach} voxels from the map's origin; use larger voxels (voxel_size_m)"
        )
    x, y, z = (blocks + _HALF).T
    keys: IntArray = (x << (2 * _BITS)) | (y << _BITS) | z
    return keys


def _blocks_of(keys: IntArray) -> IntArray:
    mask = (1 << _BITS) - 1
    return np.stack([keys >> (2 * _BITS), (keys >> _BITS) & mask, keys & mask], axis=1) - _HALF
