"""A LiDAR's grid of beams and columns, and scans projected onto it.

Each beam looks at its own yaws, which need not be those of the beam above it (staggered beams). Where in a column
the points of a beam usually lie is learnt from the first scans, so that the columns of all beams line up, and no two
neighbours fall into one pixel while the next stays empty.
Source: Cramariuc et al., maplab 2.0, RA-L 2023, section IV-C.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapstream.operators.lidar.images.beams import Beams, Directions
from mapstream.operators.operator import OperatorConfig, warn
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray
from mapstream.streams.messages.sensors import LidarScan

_YAW_BINS = 64  # of a column, in which the usual yaw is looked for
_FEWEST_COLUMNS, _MOST_COLUMNS = 256, 2048


class GridConfig(OperatorConfig):
    """The size of a LiDAR image."""

    rows: PositiveInt | None = None
    """One for each beam without; where nobody knows the beams, 64."""
    columns: PositiveInt | None = Field(default=None, ge=16)
    """Once round; without, as many as the LiDAR fires, to the nearest of 256, 512, 1024 and 2048."""
    learn_scans: PositiveInt = 5
    """From so many scans is learnt where beams and columns lie."""
    min_range_m: NonNegativeFloat = 0.1
    """Nearer points are none: the sensor's own housing, or no return."""
    max_range_m: PositiveFloat = 50.0
    """Farther points look as if they were as far as that."""


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedScan:
    """Which point of a scan each pixel shows: the highest beam first, straight ahead in the middle, left on the left."""

    scan: LidarScan
    point: IntArray  # (H, W) the row of the scan's point, -1 where nothing came back
    range_m: Float32Array  # (H, W) 0 where nothing came back
    pixel_rad: float  # between neighbours, over rows and columns

    @property
    def is_measured(self) -> BoolArray:
        """Which pixels (H, W) show a point."""
        return self.point >= 0


class ScanGrid:
    """Projects the scans of one LiDAR."""

    def __init__(self, config: GridConfig) -> None:
        self._config = config
        self._beams: Beams | None = None
        self._columns: Columns | None = None
        self._num_learnt = 0

    def project(self, scan: LidarScan) -> ProjectedScan:
        """Return a scan by pixels; of two points in one pixel, the nearer is seen."""
        directions = Directions.of(scan)
        beams = self._beams = self._beams or Beams(scan, directions, self._config.rows)
        beam = beams.of(scan, directions)
        has_row = beam < beams.count
        if not has_row.all():
            warn(f"points of {scan.frame} of beams that its first scan did not have are left out")
        is_far = directions.range_m >= max(self._config.min_range_m, 1e-6)
        seen = np.flatnonzero(is_far & has_row)
        yaw_rad, range_m = directions.yaw_rad[seen], directions.range_m[seen]
        columns = self._columns = self._columns or Columns(
            self._config.columns or usual_columns(beam[seen], yaw_rad), beams.count
        )
        if self._num_learnt < self._config.learn_scans and len(seen):
            beams.learn(beam[seen], directions.elevation_rad[seen])
            columns.learn(beam[seen], yaw_rad)
            self._num_learnt += 1
        row, column = beams.row[beam[seen]], columns.of(beam[seen], yaw_rad)
        far_first = np.argsort(-range_m, kind="stable")
        point = np.full((beams.count, columns.count), -1)
        point[row[far_first], column[far_first]] = seen[far_first]
        return ProjectedScan(
            scan=scan,
            point=point,
            range_m=np.append(directions.range_m, 0.0).astype(np.float32)[point],
            pixel_rad=float(np.sqrt(beams.step_rad * 2 * np.pi / columns.count)),
        )


class Columns:
    """Which column of the image each yaw is, beam by beam.

    Args:
        count: Of columns, once round.
        num_beams: Each of which has its own place within the columns.
    """

    def __init__(self, count: int, num_beams: int) -> None:
        self.count = count
        self._histogram = np.zeros((num_beams, _YAW_BINS))
        self._shift = np.zeros(num_beams)  # of each beam, in columns

    def learn(self, beams: IntArray, yaw_rad: FloatArray) -> None:
        """Note where in their columns points (N,) of beams are; the most frequent place becomes the middle."""
        part = np.mod(self._exact(yaw_rad), 1.0)
        bins = np.minimum((part * _YAW_BINS).astype(np.int64), _YAW_BINS - 1)
        np.add.at(self._histogram, (beams, bins), 1)
        around = sum(np.roll(self._histogram, step, axis=1) for step in (-1, 0, 1))
        usual = (np.argmax(around, axis=1) + 0.5) / _YAW_BINS
        self._shift = np.where(usual >= 0.5, usual - 1.0, usual)

    def of(self, beams: IntArray, yaw_rad: FloatArray) -> IntArray:
        """Return the column (N,) of points."""
        exact = self._exact(yaw_rad) - self._shift[beams]
        columns: IntArray = np.rint(exact).astype(np.int64) % self.count
        return columns

    def _exact(self, yaw_rad: FloatArray) -> FloatArray:
        """Return the columns of yaws, with their parts; a whole number is the middle of a column."""
        return (np.pi - yaw_rad) * (self.count / (2 * np.pi)) - 0.5


def usual_columns(beams: IntArray, yaw_rad: FloatArray) -> int:
    """Return the power of two that is nearest to the number of points that a beam takes in one turn."""
    order = np.lexsort((yaw_rad, beams))
    steps = np.diff(yaw_rad[order])[np.diff(beams[order]) == 0]
    steps = steps[steps > 1e-6]
    if not len(steps):
        return _FEWEST_COLUMNS
    exponent = round(float(np.log2(2 * np.pi / np.median(steps))))
    return int(np.clip(2**exponent, _FEWEST_COLUMNS, _MOST_COLUMNS))
