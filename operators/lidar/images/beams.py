"""Which beam of a LiDAR each point came from, and how the beams lie above each other.

A scan says it by ring numbers, or by the order of its points, beam after beam, as KITTI's files have them.
Where it says neither, rows are steps of elevation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.sensors import LidarScan

_SIZES = (16, 32, 64, 128)  # numbers of beams that LiDARs have
_LEAST_BEAMS = 8  # fewer are the lines of a LiDAR that scans in patterns of its own
_STEPS = 64  # of elevation, where beams are not known
_SEEN_PERCENTILES = (0.5, 99.5)  # of elevations, between which the steps lie


@dataclass(frozen=True, slots=True, eq=False)
class Directions:
    """Where the points of a scan are, as a LiDAR sees them."""

    yaw_rad: FloatArray  # (N,)
    elevation_rad: FloatArray  # (N,)
    range_m: FloatArray  # (N,)

    @classmethod
    def of(cls, scan: LidarScan) -> Directions:
        x, y, z = scan.points.astype(np.float64).T
        reach_m = np.hypot(x, y)
        return cls(np.arctan2(y, x), np.arctan2(z, reach_m), np.hypot(reach_m, z))


class Beams:
    """The beams of one LiDAR, and the row of the image that each of them is.

    Args:
        scan: The first one.
        directions: Of its points.
        rows: How many rows the image has; by default, what a LiDAR of so many beams has.

    Raises:
        OperatorError: If there are more beams than rows.
    """

    def __init__(self, scan: LidarScan, directions: Directions, rows: int | None) -> None:
        self._told_by: Literal["ring", "order", "elevation"] = "elevation"
        num_beams = 0
        if scan.ring is not None:
            num_beams, self._told_by = int(scan.ring.max(initial=0)) + 1, "ring"
        if num_beams < _LEAST_BEAMS:
            num_beams, self._told_by = int(turns(directions).max(initial=0)) + 1, "order"
        if not _LEAST_BEAMS <= num_beams <= _SIZES[-1]:
            num_beams, self._told_by = rows or _STEPS, "elevation"
            self._edges_rad = _even(directions.elevation_rad, num_beams)
        if rows is not None and rows < num_beams:
            raise OperatorError(
                f"scans of {scan.frame} have {num_beams} beams, told by their {self._told_by}; an image "
                f"of {rows} rows cannot hold them (leave out `rows`)"
            )
        self.count = rows or next((size for size in _SIZES if size >= num_beams), num_beams)
        self.row: IntArray = np.arange(self.count)  # of each beam
        self.step_rad = 0.0  # between neighbours, in the mean
        self._sums_rad, self._counts = np.zeros(self.count), np.zeros(self.count)

    def of(self, scan: LidarScan, directions: Directions) -> IntArray:
        """Return the beam (N,) of each point."""
        if self._told_by == "ring" and scan.ring is not None:
            return scan.ring.astype(np.int64)
        if self._told_by == "order":
            return turns(directions)
        return np.searchsorted(self._edges_rad, directions.elevation_rad).astype(np.int64)

    def learn(self, beams: IntArray, elevation_rad: FloatArray) -> None:
        """Note how high points (N,) of beams are; the highest beam becomes the first row."""
        self._sums_rad += np.bincount(beams, elevation_rad, self.count)
        self._counts += np.bincount(beams, minlength=self.count)
        known = np.flatnonzero(self._counts)
        means = self._sums_rad[known] / self._counts[known]
        slope, start = np.polyfit(known, means, 1) if len(known) > 1 else (-1.0, 0.0)
        elevations = start + slope * np.arange(self.count)  # of beams that saw nothing so far
        elevations[known] = means
        self.step_rad = float(np.ptp(elevations)) / max(self.count - 1, 1)
        self.row = np.empty(self.count, np.int64)
        self.row[np.argsort(-elevations, kind="stable")] = np.arange(self.count)


def turns(directions: Directions) -> IntArray:
    """Return in which turn of the sensor each point (N,) was taken, whichever way it turns.

    Points that come column by column make one turn, those that come beam by beam one for each beam.
    A turn begins ahead or behind: where the elevation steps more.
    """
    steps = np.abs(np.diff(directions.elevation_rad, prepend=directions.elevation_rad[:1]))
    ahead, behind = (_wraps(np.mod(directions.yaw_rad + start, 2 * np.pi)) for start in (0, np.pi))
    heights = [np.median(steps[cut != 0]) if cut.any() else 0.0 for cut in (ahead, behind)]
    chosen = ahead if heights[0] >= heights[1] else behind
    direction = 1 if chosen.sum() >= 0 else -1
    turn: IntArray = np.maximum.accumulate(np.cumsum(chosen * direction)).clip(0)
    return turn


def _wraps(yaw_rad: FloatArray) -> IntArray:
    """Return 1 where yaws (N,) of 0 to 2 pi begin anew, -1 where they do so backwards."""
    steps = np.diff(yaw_rad, prepend=yaw_rad[:1])
    return np.where(np.abs(steps) > np.pi, -np.sign(steps), 0).astype(np.int64)


def _even(elevation_rad: FloatArray, count: int) -> FloatArray:
    """Return the edges (count - 1,) between even steps of elevation, low to high."""
    seen = elevation_rad if len(elevation_rad) else np.zeros(1)
    low, high = np.percentile(seen, _SEEN_PERCENTILES)
    edges: FloatArray = np.linspace(low, high, count + 1)[1:-1]
    return edges
