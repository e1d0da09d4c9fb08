"""Where a point seen in one view may be in another, when the motion between them is known.

Seen from the second view, a point lies on the great circle from its ray in the first view, turned (it is
infinitely far), to the direction in which the first camera lies (it is infinitely near).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import FloatArray

BoolArray = npt.NDArray[np.bool_]


def on_arc(start: FloatArray, end: FloatArray, goals: FloatArray, limit_rad: float) -> BoolArray:
    """Return which points (T, N) are within an angle of their arc, for each of T motions.

    Of an end off its arc three parts are compared: beside it, before its start, and beyond the goal; all times
    the sine of the arc, which is small where start and goal are close.

    Args:
        start: (N, 3) unit rays in the first view, turned into the second one.
        end: (N, 3) unit rays in the second view; a row that is not finite is on no arc.
        goals: (T, 3) unit directions from the second camera to the first.
        limit_rad: Largest angle.
    """
    start_goal, end_goal = goals @ start.T, goals @ end.T  # (T, N) cosines
    start_end = (start * end).sum(axis=1)
    margin = np.sin(limit_rad) * np.sqrt(np.maximum(1 - start_goal**2, 0))
    fits: BoolArray = np.abs(goals @ np.cross(start, end).T) < margin
    fits &= end_goal - start_goal * start_end > -margin
    fits &= start_goal * end_goal - start_end < margin
    return fits
