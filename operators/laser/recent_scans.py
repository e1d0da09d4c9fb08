"""What the last scans saw around the robot: the map that the next scan is matched to."""

from __future__ import annotations

from collections import deque

import numpy as np

from mapstream.operators.laser.matching import LineTarget
from mapstream.operators.laser.planar import difference
from mapstream.operators.laser.surfaces import Surface
from mapstream.streams.arrays import FloatArray, IntArray


class RecentScans:
    """Surfaces of the last keyframes, merged; of two points in a cell the newer stays."""

    def __init__(self, num_keyframes: int, cell_m: float) -> None:
        self._surfaces: deque[Surface] = deque(maxlen=num_keyframes)
        self._cell_m = cell_m
        self._newest: FloatArray = np.zeros(3)
        self.target: LineTarget | None = None  # None before the first

    def clear(self) -> None:
        """Forget everything."""
        self._surfaces.clear()
        self.target = None

    def add(self, surface: Surface, pose: FloatArray) -> None:
        """Take in what a scan saw at a pose (3,), and let the oldest go."""
        self._surfaces.appendleft(surface.lined().moved(pose))
        self._newest = pose
        points = np.concatenate([part.points for part in self._surfaces])
        normals = np.concatenate([part.normals for part in self._surfaces])
        kept = first_in_cells(points, self._cell_m)
        self.target = LineTarget(Surface(points[kept], normals[kept]))

    def away(self, pose: FloatArray) -> FloatArray:
        """Return the tangent (3,) from the newest keyframe to a pose."""
        return difference(self._newest, pose)


def first_in_cells(points: FloatArray, cell_m: float) -> IntArray:
    """Return the indices, in order, of the first point (N, 2) in each cell."""
    cells = np.floor(points / cell_m).astype(np.int64)
    _, first = np.unique((cells[:, 0] << 32) + cells[:, 1], return_index=True)
    kept: IntArray = np.sort(first)
    return kept
