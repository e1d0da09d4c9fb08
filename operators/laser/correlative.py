"""Finding where a planar scan fits when its pose is known only roughly.

Poses on a grid around the guess are ranked by how likely the scan's points are there; a pyramid of maxima bounds what
a whole block of poses can reach, so that few have to be looked at, and the best is sure to be found.
Source: Olson, Real-time correlative scan matching, ICRA 2009; the bounds: Hess et al., Real-time loop closure in 2D
LIDAR SLAM, ICRA 2016, section V.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.operators.laser.planar import apply
from mapstream.streams.arrays import FloatArray, IntArray

_NUM_LEVELS = 4  # up to blocks of 16 x 16 poses
_BATCH = 64  # blocks that are looked into together
_MAX_POINTS = 150
_MAX_SIDE = 4096  # cells of a grid

Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """How far around the guess to look, and how finely."""

    radius_m: float
    turn_rad: float
    turn_step_rad: float = float(np.radians(1.5))


@dataclass(frozen=True, slots=True, eq=False)
class Basin:
    """The best pose on the grid."""

    pose: FloatArray  # (3,)
    score: float  # mean likelihood of the points, at most 1


class LikelihoodGrid:
    """How likely a point is to lie in a cell, by its distance from the nearest of the target's points."""

    def __init__(
        self,
        points: FloatArray,
        *,
        resolution_m: float = 0.05,
        sigma_m: float = 0.1,
        num_levels: int = _NUM_LEVELS,
    ) -> None:
        """Make the pyramid; more levels make wide windows fast, and narrow ones slow."""
        margin_m = 4 * sigma_m
        self.resolution_m = resolution_m
        self._origin_m = points.min(axis=0) - margin_m
        size = np.ceil((np.ptp(points, axis=0) + 2 * margin_m) / resolution_m).astype(int) + 1
        columns, rows = np.minimum(size, _MAX_SIDE).tolist()
        empty = np.ones((rows, columns), np.uint8)
        cells = self.cells(points)
        inside = (cells < [columns, rows]).all(axis=1)
        empty[cells[inside, 1], cells[inside, 0]] = 0
        far = cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * resolution_m
        likelihood = np.exp(-0.5 * (far / sigma_m) ** 2)
        self._levels: list[Bytes] = [np.round(255 * likelihood).astype(np.uint8)]
        for level in range(1, num_levels + 1):
            self._levels.append(_block_maxima(self._levels[-1], 2 ** (level - 1)))

    def cells(self, points: FloatArray) -> IntArray:
        """Return the column and row (N, 2) that points (N, 2) lie in."""
        cells: IntArray = np.floor((points - self._origin_m) / self.resolution_m).astype(np.int64)
        return cells

    def search(
        self, points: FloatArray, guess: FloatArray, window: Window, least_score: float = 0.0
    ) -> Basin:
        """Return the likeliest pose of points (N, 2) within the window; of equals one, always the same.

        The search ends when no pose can reach `least_score`: the pose is then a rough one, with a lower score.
        """
        if len(points) > _MAX_POINTS:
            points = points[np.linspace(0, len(points) - 1, _MAX_POINTS).astype(int)]
        num_turns = int(np.ceil(window.turn_rad / window.turn_step_rad))
        turns = np.arange(-num_turns, num_turns + 1) * window.turn_step_rad
        starts = guess + turns[:, None] * np.array([0.0, 0.0, 1.0])
        cells = np.array([self.cells(apply(start, points)) for start in starts])
        reach = int(np.ceil(window.radius_m / self.resolution_m))
        shifts = np.arange(-reach, reach + 1, 2 ** (len(self._levels) - 1))
        first = np.stack(np.meshgrid(np.arange(len(turns)), shifts, shifts, indexing="ij"), -1)
        best, score = self._best(cells, first.reshape(-1, 3), reach, least_score)
        shift_m = best[1:] * self.resolution_m
        pose = np.append(guess[:2] + shift_m, guess[2] + turns[best[0]])
        return Basin(pose, score)

    def _best(
        self, cells: IntArray, blocks: IntArray, reach: int, least_score: float
    ) -> tuple[IntArray, float]:
        """Look into the blocks that promise most, until one pose is better than all other blocks can be."""
        heap: list[tuple[float, int, tuple[int, ...]]] = []
        self._push(heap, cells, blocks, len(self._levels) - 1)
        while heap[0][1] > 0 and -heap[0][0] >= least_score:
            level = heap[0][1]
            batch = [heapq.heappop(heap)]
            while heap and len(batch) < _BATCH and heap[0][1] == level:
                batch.append(heapq.heappop(heap))
            parents = np.array([block for _, _, block in batch])
            half = 2 ** (level - 1)
            quarters = np.array([[0, 0, 0], [0, half, 0], [0, 0, half], [0, half, half]])
            children = (parents[:, None] + quarters).reshape(-1, 3)
            children = children[(children[:, 1:] <= reach).all(axis=1)]
            self._push(heap, cells, children, level - 1)
        bound, _, block = heap[0]
        return np.array(block), -bound

    def _push(
        self,
        heap: list[tuple[float, int, tuple[int, ...]]],
        cells: IntArray,
        blocks: IntArray,
        level: int,
    ) -> None:
        scores = self._scores(cells, blocks, level)
        for score, block in zip(scores.tolist(), blocks.tolist(), strict=True):
            heapq.heappush(heap, (-score, level, tuple(block)))

    def _scores(self, cells: IntArray, blocks: IntArray, level: int) -> FloatArray:
        """Return the most that any pose in each block (N, 3) of turn, column, row can score."""
        grid = self._levels[level]
        span = 2**level - 1  # the maxima begin so many cells before the grid
        rows, columns = grid.shape
        scores = np.empty(len(blocks))
        for start in range(0, len(blocks), 2048):
            part = blocks[start : start + 2048]
            at = cells[part[:, 0]] + part[:, None, 1:] + span
            inside = (at >= 0).all(axis=-1) & (at < [columns, rows]).all(axis=-1)
            at = np.where(inside[..., None], at, 0)
            likelihood = np.where(inside, grid[at[..., 1], at[..., 0]], 0)
            scores[start : start + 2048] = likelihood.mean(axis=1) / 255
        return scores


def _block_maxima(grid: Bytes, half: int) -> Bytes:
    """Return maxima over twice the block of `grid`, which begin `half` cells further before the first cell."""
    padded = np.pad(grid, half)
    maxima = padded[:-half, :-half].copy()
    for part in (padded[half:, :-half], padded[:-half, half:], padded[half:, half:]):
        np.maximum(maxima, part, out=maxima)
    return maxima
