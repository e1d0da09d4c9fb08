"""What beams cannot have passed: the walls of a floor, as cells with the directions that they face."""

from __future__ import annotations

import numpy as np

from mapstream.operators.laser.surfaces import Surface
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

_BEHIND_M = 0.3  # beams that end so near behind a wall may have ended on it
_STEEP = 0.5  # cosine to the normal; beams that graze a wall cross it by small errors of the pose
_MAX_CELLS = 100_000_000


class Walls:
    """Cells of walls, and how a beam would cross them."""

    def __init__(self, surface: Surface, cell_m: float) -> None:
        """Take in the points of a surface that lie on lines."""
        lined = surface.lined()
        self._corner_m = lined.points.min(axis=0)
        size = np.ptp(lined.points, axis=0)
        self._cell_m = max(cell_m, float(np.sqrt(size.prod() / _MAX_CELLS)))
        cells = self._cells(lined.points)
        self._index = np.full(cells.max(axis=0) + 1, -1, np.int32)
        self._index[cells[:, 0], cells[:, 1]] = np.arange(len(cells))
        self._normals = lined.normals

    def crossed(self, points: FloatArray, eye: FloatArray) -> BoolArray:
        """Return for each beam from `eye` (2,) to one of points (N, 2) whether it passes through a wall (N,)."""
        ways = points - eye
        lengths = np.linalg.norm(ways, axis=1)
        crossed: BoolArray = np.zeros(len(points), np.bool_)
        free_m = lengths - _BEHIND_M
        if not (free_m > 0).any():
            return crossed
        steps_m = np.arange(0.0, free_m.max(), self._cell_m)
        directions = ways / np.maximum(lengths, 1e-9)[:, None]
        cells = self._cells(eye + steps_m[:, None] * directions[:, None])  # (N, S, 2)
        inside = (cells >= 0).all(axis=-1) & (cells < self._index.shape).all(axis=-1)
        inside &= steps_m < free_m[:, None]
        beams, steps = np.nonzero(inside)
        at = cells[beams, steps]
        walls = self._index[at[:, 0], at[:, 1]]
        beams, walls = beams[walls >= 0], walls[walls >= 0]
        cosines = np.einsum("nc,nc->n", directions[beams], self._normals[walls])
        crossed[beams[np.abs(cosines) > _STEEP]] = True
        return crossed

    def _cells(self, points: FloatArray) -> IntArray:
        cells: IntArray = np.floor((points - self._corner_m) / self._cell_m).astype(np.int64)
        return cells
