"""Floor plans as robots use them: which cells are free, which are not."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import frozen
from mapstream.streams.geometry import SE3

UNKNOWN: Final = -1
FREE: Final = 0
OCCUPIED: Final = 100


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OccupancyGrid:
    """Square cells on the ground, with how likely each is occupied.

    The cell in row r and column c spans from (c, r) to (c + 1, r + 1) times the resolution, in the x and
    y of the grid; so the first row is the lowest, as in `nav_msgs/OccupancyGrid`.
    """

    stamp_ns: int
    cells: npt.NDArray[np.int8]  # (H, W) 0 to 100 percent, -1 unknown
    resolution_m: float  # side of a cell
    T_map_grid: SE3 = field(default_factory=SE3.identity)  # of the lower left corner

    def __post_init__(self) -> None:
        frozen(self, "cells", np.int8, (None, None))
        if not self.resolution_m > 0:
            raise ValueError(f"OccupancyGrid: cells of {self.resolution_m} m")
