"""Large surfaces in parts, so that each is drawn with the level of detail of its distance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from mapstream.recordings.worlds.surfaces import Surface
from mapstream.streams.arrays import FloatArray

_TILE_M = 2.5


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """A part of a surface, or all of it."""

    surface: int  # its row in the world
    corners: FloatArray  # (4, 3) [m] of its bounding rectangle
    edges: FloatArray  # (E, 3) lines on the surface's plane, `line @ [s, t, 1] >= 0` inside


def tiles_of(row: int, surface: Surface) -> Iterator[Tile]:
    """Cut a rectangle into parts; they share its picture, so that no seam is seen."""
    if not surface.is_rectangle:
        (width, height), edges = surface.size_m.tolist(), surface.edges()
        yield Tile(row, surface.points(_rectangle(0, width, 0, height)), edges)
        return
    counts = np.maximum(1, np.ceil(surface.size_m / _TILE_M)).astype(int)
    s, t = (
        np.linspace(0, side, n + 1).tolist() for side, n in zip(surface.size_m, counts, strict=True)
    )
    for s0, s1 in pairwise(s):
        for t0, t1 in pairwise(t):
            edges = np.array([[1, 0, -s0], [-1, 0, s1], [0, 1, -t0], [0, -1, t1]])
            corners = surface.points(_rectangle(s0, s1, t0, t1))
            yield Tile(row, corners, edges)


def _rectangle(s0: float, s1: float, t0: float, t1: float) -> FloatArray:
    return np.array([[s0, t0], [s1, t0], [s1, t1], [s0, t1]])
