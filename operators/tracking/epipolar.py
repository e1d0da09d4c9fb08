"""Where a point seen in one view may be in another, when the motion between them is known.

Seen from the second view, a point lies on the great circle from its ray in the first view, turned (it is
infinitely far), to the direction in which the first camera lies (it is infinitely near).
"""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import FloatArray


def off_arc(start: FloatArray, end: FloatArray, goals: FloatArray, limit_rad: float) -> FloatArray:
    """Return how far points (T, N) are beside their arcs [rad], for each of T motions; infinite beyond a limit.

    So they are, too, if they are farther than that before an arc's start or behind its goal.

    Args:
        start: (N, 3) unit rays in the first view, turned into the second one.
        end: (N, 3) unit rays in the second view; a row that is not finite is on no arc.
        goals: (T, 3) unit directions from the second camera to the first.
        limit_rad: Largest angle; small.
    """
    start_goal, end_goal = goals @ start.T, goals @ end.T  # (T, N) cosines
    start_end = (start * end).sum(axis=1)
    arc = np.sqrt(np.maximum(1 - start_goal**2, 0))  # its sine, which all parts are multiples of
    margin = np.sin(limit_rad) * arc
    beside = np.abs(goals @ np.cross(start, end).T)
    fits = beside < margin
    fits &= end_goal - start_goal * start_end > -margin
    fits &= start_goal * end_goal - start_end < margin
    missed: FloatArray = np.where(fits, beside / np.where(arc > 0, arc, 1), np.inf)
    return missed
