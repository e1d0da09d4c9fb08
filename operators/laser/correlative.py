"""Finding where a planar scan fits when its pose is known only roughly.

Poses on a grid around the guess are ranked by how likely the scan's points are there; a pyramid of maxima bounds what
a whole block of poses can reach, so that few have to be looked at, and the best is sure to be found.
Source: Olson, Real-time correlative scan matching, ICRA 2009; the bounds: Hess et al., Real-time loop closure in 2D
LIDAR SLAM, ICRA 2016, section V.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from mapstream.operators.laser.planar import apply
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

_NUM_LEVELS = 4  # up to blocks of 16 x 16 poses
_BATCH = 64  # blocks that are looked into together
_MAX_POINTS = 150
_MAX_SIDE = 4096  # cells of a grid
_APART_M = 0.5  # poses count as different from so far apart, along an axis
_APART_RAD = 0.25  # or in direction

Bytes = npt.NDArray[np.uint8]
_Block = tuple[float, int, tuple[int, ...]]  # less its bound, its level, its first pose


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """How far around the guess to look, and how finely."""

    radius_m: float
    turn_rad: float
    turn_step_rad: float = float(np.radians(1.5))


@dataclass(frozen=True, slots=True, eq=False)
class Basin:
    """The best pose on the grid, or around it."""

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

    def search(self, points: FloatArray, guess: FloatArray, window: Window) -> Basin:
        """Return the likeliest pose of points (N, 2) within the window; of equals one, always the same."""
        return next(self.basins(points, guess, window))

    def basins(
        self,
        points: FloatArray,
        guess: FloatArray,
        window: Window,
        least_score: float = 0.0,
        within: float = 1.0,
    ) -> Iterator[Basin]:
        """Yield the likeliest pose of points (N, 2) within the window, then the likeliest apart from it, and so on.

        Args:
            points: Of the scan.
            guess: (3,) the middle of the window.
            window: Where to look.
            least_score: It ends when no pose apart from the others can reach that.
            within: It ends as well when none can come so near to the score of the best.
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
        heap: list[_Block] = []
        self._push(heap, cells, first.reshape(-1, 3), len(self._levels) - 1)
        taken: list[FloatArray] = []
        while heap and -heap[0][0] >= least_score:
            batch = _promising(heap, least_score)
            for level in np.unique(batch[:, 0]).tolist():
                blocks = batch[batch[:, 0] == level, 1:]
                shifts_m = blocks[:, 1:] * self.resolution_m
                low = np.column_stack([guess[:2] + shifts_m, guess[2] + turns[blocks[:, 0]]])
                blocks = blocks[~self._is_taken(low, level, taken)]
                if level:
                    self._push(heap, cells, _quarters(blocks, level, reach), level - 1)
                elif len(blocks):
                    score = float(self._scores(cells, blocks, 0)[0])
                    if not taken:
                        least_score = max(least_score, score - within)
                    taken.append(low[0])
                    yield Basin(low[0], score)

    def _is_taken(self, low: FloatArray, level: int, taken: list[FloatArray]) -> BoolArray:
        """Return which blocks (N,), each by its first pose (N, 3), lie wholly near a pose that was found."""
        middle_m = (2**level - 1) * self.resolution_m / 2
        is_taken = np.zeros(len(low), np.bool_)
        for pose in taken:
            off = np.abs(low - pose + [middle_m, middle_m, 0.0])
            turn = np.minimum(off[:, 2] % (2 * np.pi), -off[:, 2] % (2 * np.pi))
            is_taken |= (off[:, :2].max(axis=1) + middle_m < _APART_M) & (turn < _APART_RAD)
        return is_taken

    def _push(
        self,
        heap: list[_Block],
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
            column, row = np.moveaxis(cells[part[:, 0]] + part[:, None, 1:] + span, -1, 0)
            # as unsigned numbers, negative ones are large
            inside = (column.view(np.uint64) < columns) & (row.view(np.uint64) < rows)
            likelihood = grid.take(row * columns + column, mode="clip") * inside
            scores[start : start + 2048] = likelihood.mean(axis=1) / 255
        return scores


def _promising(heap: list[_Block], least_score: float) -> IntArray:
    """Take the blocks out that promise most, (N, 4) with the level first; a pose comes alone."""
    _, level, block = heapq.heappop(heap)
    batch = [(level, *block)]
    while level and heap and len(batch) < _BATCH and heap[0][1] and -heap[0][0] >= least_score:
        _, level, block = heapq.heappop(heap)
        batch.append((level, *block))
    return np.array(batch)


def _quarters(blocks: IntArray, level: int, reach: int) -> IntArray:
    """Return the blocks of the next level that make up some (N, 3) of this one, as far as the window reaches."""
    half = 2 ** (level - 1)
    corners = np.array([[0, 0, 0], [0, half, 0], [0, 0, half], [0, half, half]])
    children: IntArray = (blocks[:, None] + corners).reshape(-1, 3)
    return children[(children[:, 1:] <= reach).all(axis=1)]


def _block_maxima(grid: Bytes, half: int) -> Bytes:
    """Return maxima over twice the block of `grid`, which begin `half` cells further before the first cell."""
    padded = np.pad(grid, half)
    maxima = padded[:-half, :-half].copy()
    for part in (padded[half:, :-half], padded[:-half, half:], padded[half:, half:]):
        np.maximum(maxima, part, out=maxima)
    return maxima
