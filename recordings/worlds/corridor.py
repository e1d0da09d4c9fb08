"""A ring of corridors and what stands in it.

Smooth walls say nothing of the motion along them, and on smooth ground point-to-point ICP locks to the
rings of the scan; hence niches, doors, pillars, shelves, beams, clutter and rough plaster.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.recordings.worlds.mesh import Mesh, box, join, sheet
from mapstream.recordings.worlds.ring import Ring
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.geometry import SE3, so3_exp

_GRID_M = 0.5
_EDGE_M = 0.01  # half the thickness of a step in a wall
_HALF_WIDTH_M = 2.4
_WIDENING_M = 0.25  # amplitude of the slow waves of each wall
_HEIGHT_M = 4.5
_ROUGHNESS_M = 0.03  # standard deviation of the plaster
_FLOOR, _WALL, _CEILING = 0.3, 0.5, 0.75  # reflectivity


@dataclass(frozen=True, slots=True)
class _Relief:
    """A stretch of wall or ceiling that stands out, or back where `depth_m` is negative."""

    start_m: float
    end_m: float
    bottom_m: float
    top_m: float
    depth_m: float
    reflectivity: float


_KINDS = (  # what a wall may show: length, bottom, top, depth [m], reflectivity
    (1.0, -1.0, 2.4, -0.4, 0.8),  # door
    (0.6, -1.0, 6.0, 0.6, 0.65),  # pillar
    (2.0, -1.0, 6.0, -0.9, 0.4),  # niche
    (1.4, 0.9, 1.9, 0.35, 0.2),  # shelf
    (0.4, -1.0, 6.0, 0.4, 0.9),  # pipe
)


class Corridor:
    """One ring of corridors; `mesh` builds it."""

    def __init__(self, ring: Ring, rng: np.random.Generator, *, is_blank: bool = False) -> None:
        """Describe a corridor; a blank one is smooth and empty, and so a degenerate place."""
        self.ring = ring
        self.is_blank = is_blank
        self._rng = rng
        self._phases = rng.uniform(0, 2 * np.pi, 2)

    def mesh(self) -> Mesh:
        """Return the walls, the floor, the ceiling and the clutter."""
        walls = [self._wall(side) for side in (0, 1)]
        floor = self._slab(0.0, [], _FLOOR)
        ceiling = self._slab(_HEIGHT_M, [] if self.is_blank else self._beams(), _CEILING)
        return join([*walls, floor, ceiling, *([] if self.is_blank else self._clutter())])

    def _half_width(self, s_m: FloatArray, side: int) -> FloatArray:
        wave = np.sin(2 * np.pi * (3 + side) * s_m / self.ring.length_m + self._phases[side])
        width: FloatArray = _HALF_WIDTH_M + (0.0 if self.is_blank else _WIDENING_M) * wave
        return width

    def _wall(self, side: int) -> Mesh:
        reliefs = [] if self.is_blank else self._wall_reliefs()
        s, z = self._stations(reliefs), _heights(reliefs)
        out, reflectivity = _outstanding(s, z, reliefs, _WALL)
        reach = self._half_width(s, side)[:, None] - out - self._plaster(out.shape, _ROUGHNESS_M)
        left = reach if side == 0 else -reach
        return sheet(self.ring.points(s[:, None], left, z), reflectivity)

    def _slab(self, up_m: float, reliefs: list[_Relief], base: float) -> Mesh:
        s, across = self._stations(reliefs), np.linspace(-1, 1, 13)
        out, reflectivity = _outstanding(s, np.zeros(len(across)), reliefs, base)
        right, left = (self._half_width(s, side) + 1.0 for side in (1, 0))  # beyond the niches
        offset = np.where(across < 0, right[:, None] * across, left[:, None] * across)
        up = up_m - out + self._plaster(out.shape, _ROUGHNESS_M / 2)
        return sheet(self.ring.points(s[:, None], offset, up), reflectivity)

    def _plaster(self, shape: tuple[int, ...], roughness_m: float) -> FloatArray:
        """Return a random relief (M, N) whose last row is its first, for the ring closes there."""
        relief = self._rng.normal(0.0, 0.0 if self.is_blank else roughness_m, shape)
        relief[-1] = relief[0]
        return relief

    def _stations(self, reliefs: list[_Relief]) -> FloatArray:
        """Return distances along the ring for the grid: even, and close together at every edge."""
        edges = np.array([s for r in reliefs for s in (r.start_m, r.end_m)])
        return _grid(0.0, self.ring.length_m, edges)

    def _wall_reliefs(self) -> list[_Relief]:
        reliefs, start = [], 1.0
        while start < self.ring.length_m - 4.0:
            length, bottom, top, depth, reflectivity = _KINDS[self._rng.integers(len(_KINDS))]
            end = start + length * self._rng.uniform(0.8, 1.3)
            depth *= self._rng.uniform(0.7, 1.2)
            reliefs.append(_Relief(start, end, bottom, top, depth, reflectivity))
            start = end + self._rng.uniform(0.3, 1.2)
        return reliefs

    def _beams(self) -> list[_Relief]:
        starts = np.cumsum(self._rng.uniform(2.5, 6.0, int(self.ring.length_m / 2.5)))
        starts = starts[starts < self.ring.length_m - 1.0]
        return [_Relief(s, s + 0.35, -1.0, 1.0, self._rng.uniform(0.15, 0.4), 0.6) for s in starts]

    def _clutter(self) -> list[Mesh]:
        """Return crates on both sides, steps of three treads among them, and lamps overhead."""
        boxes = []
        for n, s in enumerate(np.arange(2.5, self.ring.length_m - 2.5, 0.6)):
            side, size = n % 2, self._rng.uniform([0.3, 0.3, 0.5], [1.0, 0.8, 2.2])
            s_m = s + self._rng.uniform(-0.4, 0.4)
            if n % 9 == 8:
                boxes.append(self._box(s_m, side, np.array([1.2, 0.3, 0.1]), _HEIGHT_M - 0.8))
            elif n % 20 == 19:
                treads = [np.array([0.3, 0.8, 0.34 * k]) for k in (1, 2, 3)]
                boxes += [
                    self._box(s_m + 0.3 * k, side, tread, 0.0) for k, tread in enumerate(treads)
                ]
            else:
                boxes.append(self._box(s_m, side, size, size[2] / 2))
        return boxes

    def _box(self, s_m: float, side: int, size_m: FloatArray, up_m: float) -> Mesh:
        s = np.array([s_m])
        reach = self._half_width(s, side) - size_m[1] / 2
        turn = self.ring.headings(s)[0] + self._rng.uniform(-0.2, 0.2)
        centre = self.ring.points(s, reach if side == 0 else -reach, up_m)[0]
        T_world_box = SE3.from_rotation(so3_exp([0, 0, turn]), centre)
        return box(T_world_box, size_m, self._rng.uniform(0.1, 0.9))


def _heights(reliefs: list[_Relief]) -> FloatArray:
    """Return heights over the floor for the grid of a wall."""
    edges = np.array([z for r in reliefs for z in (r.bottom_m, r.top_m)])
    return _grid(-0.1, _HEIGHT_M + 0.4, edges)


def _grid(start_m: float, end_m: float, edges_m: FloatArray) -> FloatArray:
    """Return places from start to end: two at every edge between them, and even ones where no edge is near."""
    even = np.linspace(start_m, end_m, round((end_m - start_m) / _GRID_M) + 1)
    edges = edges_m[(edges_m > start_m + _EDGE_M) & (edges_m < end_m - _EDGE_M)]
    gaps = np.abs(even[1:-1, None] - edges).min(axis=1, initial=np.inf)
    steps = (edges[:, None] + [-_EDGE_M, _EDGE_M]).ravel()
    return np.unique(np.concatenate([even[[0, -1]], even[1:-1][gaps > _GRID_M / 2], steps]))


def _outstanding(
    s_m: FloatArray, z_m: FloatArray, reliefs: list[_Relief], base: float
) -> tuple[FloatArray, Float32Array]:
    """Return how far each grid point (M, N) stands out [m], and the cells' reflectivity (M-1, N-1)."""
    out = np.zeros((len(s_m), len(z_m)))
    reflectivity = np.full((len(s_m) - 1, len(z_m) - 1), base, dtype=np.float32)
    for r in reliefs:
        rows = slice(*np.searchsorted(s_m, [r.start_m, r.end_m]))
        columns = slice(*np.searchsorted(z_m, [r.bottom_m, r.top_m]))
        out[rows, columns] = r.depth_m
        reflectivity[rows, columns] = r.reflectivity
    return out, reflectivity
