"""A grid of cells that beams passed or ended in, as logarithms of odds.

Source: Moravec, Elfes: High resolution maps from wide angle sonar, ICRA 1985; Thrun, Burgard, Fox: Probabilistic
Robotics, 2005, section 9.2. Of one scan a cell is counted once, as hit if any beam ended in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from pydantic import Field, PositiveFloat, PositiveInt

from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import Float32Array, FloatArray, IntArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.grids import OccupancyGrid

_BLOCK = 256  # cells by which the grid grows at least
_SHIFT = 6  # fractional bits of the ends of drawn beams
_PASSED, _HIT = 1, 2


class OddsConfig(OperatorConfig):
    """What a beam says of the cells that it passes, and of the one where it ends."""

    resolution_m: PositiveFloat = 0.05
    """Side of a cell."""
    hit: float = Field(default=0.85, gt=0.5, lt=1.0, description="probability, of one scan")
    passed: float = Field(default=0.2, gt=0.0, lt=0.5, description="the same, of being occupied")
    most: float = Field(
        default=0.98, gt=0.5, lt=1.0, description="no cell is more certain, so that maps can change"
    )
    max_cells: PositiveInt = 100_000_000
    """Of the whole grid, four bytes each."""


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """What one scan says of the plane, in the frame of the grid."""

    hits: FloatArray  # (N, 2) [m]
    passed: FloatArray  # (M, 2, 2) starts and ends of free ways [m]

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the least and the greatest coordinates (2,) [m]."""
        points = np.concatenate([self.hits, self.passed.reshape(-1, 2)])
        return points.min(axis=0), points.max(axis=0)


class OddsGrid:
    """Grows with what is seen; its cells are multiples of the resolution from the origin of its frame."""

    def __init__(self, config: OddsConfig) -> None:
        self._config = config
        self._hit, self._passed, self._most = (
            float(np.log(p / (1 - p))) for p in (config.hit, config.passed, config.most)
        )
        self._corner: IntArray = np.zeros(2, np.int64)  # column and row of the first cell
        self._odds: Float32Array = np.zeros((0, 0), np.float32)  # (rows, columns); 0: not seen

    def add(self, rays: Rays) -> None:
        """Take in what one scan saw.

        Raises:
            MapError: If the grid would have too many cells.
        """
        if not len(rays.hits) and not len(rays.passed):
            return
        low, high = (
            np.floor(b / self._config.resolution_m).astype(np.int64) for b in rays.bounds()
        )
        self._reach(low, high + 1)
        drawn = np.zeros((high - low + 1)[::-1], np.uint8)
        ends = (
            rays.passed / self._config.resolution_m - low - 0.5
        )  # pixels count from their middles
        fixed = np.rint(ends * 2**_SHIFT).astype(np.int32)
        cv2.polylines(drawn, list(fixed), False, _PASSED, 1, cv2.LINE_8, _SHIFT)  # noqa: FBT003  # not closed
        columns, rows = (np.floor(rays.hits / self._config.resolution_m).astype(np.int64) - low).T
        drawn[rows, columns] = _HIT
        step = np.array([0.0, self._passed, self._hit], np.float32)[drawn]
        column, row = low - self._corner
        window = self._odds[row : row + drawn.shape[0], column : column + drawn.shape[1]]
        np.clip(window + step, -self._most, self._most, out=window)

    def _reach(self, low: IntArray, high: IntArray) -> None:
        """Grow until the cells from `low` to below `high`, columns and rows, are there."""
        size = np.array(self._odds.shape[::-1])
        if not self._odds.size:
            self._corner = low
        if (low >= self._corner).all() and (high <= self._corner + size).all() and size.all():
            return
        start = np.where(low < self._corner, low - _BLOCK, self._corner)
        end = np.where(high > self._corner + size, high + _BLOCK, self._corner + size)
        columns, rows = end - start
        if rows * columns > self._config.max_cells:
            raise MapError(
                f"a grid of {columns} x {rows} cells of {self._config.resolution_m} m has more than"
                f" {self._config.max_cells}; use larger cells, or allow more (max_cells)"
            )
        odds = np.zeros((rows, columns), np.float32)
        column, row = self._corner - start
        odds[row : row + size[1], column : column + size[0]] = self._odds
        self._corner, self._odds = start, odds

    def grid(self, stamp_ns: int, height_m: float = 0.0) -> OccupancyGrid:
        """Return the part that was seen, as probabilities.

        Raises:
            MapError: If nothing was seen.
        """
        seen = self._odds != 0
        rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
        if not len(rows):
            raise MapError("no beam reached any cell, so there is no grid")
        part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        percent = np.rint(100 / (1 + np.exp(-self._odds[part])))
        first = self._corner + np.array([columns[0], rows[0]])
        corner = first * self._config.resolution_m
        return OccupancyGrid(
            stamp_ns=stamp_ns,
            cells=np.where(seen[part], percent, -1).astype(np.int8),
            resolution_m=self._config.resolution_m,
            T_map_grid=SE3.from_rotation(np.eye(3), [*corner, height_m]),
        )
