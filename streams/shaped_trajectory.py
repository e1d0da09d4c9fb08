"""A pose at any time: few poses that are right, and between them the shape of a motion that drifts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert, se3_exp, se3_log
from mapstream.streams.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShapedTrajectory:
    """Optimised poses, joined by odometry.

    It goes through every anchor exactly. Between two of them it moves as the odometry did, and what the
    odometry is off by at the second anchor is spread over the interval in proportion to time.
    """

    anchors: Trajectory  # T_reference_body, for instance the vertices of a mission
    shape: Trajectory  # T_odom_body, which covers the anchors' time

    def at(self, stamps_ns: npt.ArrayLike) -> FloatArray:
        """Return poses T_reference_body (M, 4, 4) at stamps (M,).

        Raises:
            ValueError: If a stamp lies outside the anchors, or the odometry does not cover it.
        """
        query = np.atleast_1d(np.asarray(stamps_ns, dtype=np.int64))
        outside = [int(stamp) for stamp in query if not self.anchors.covers(int(stamp))]
        if outside:
            raise ValueError(f"stamp {outside[0]} lies outside the anchors")
        stamps = self.anchors.stamps_ns
        right = np.clip(np.searchsorted(stamps, query), 1, max(len(stamps) - 1, 1))
        left, right = right - 1, np.minimum(right, len(stamps) - 1)
        shape_left, shape_right = self.shape.at(stamps[left]), self.shape.at(stamps[right])
        T_left_right = invert(self.anchors.poses[left]) @ self.anchors.poses[right]
        miss = se3_log(invert(invert(shape_left) @ shape_right) @ T_left_right)
        fraction = (query - stamps[left]) / np.maximum(stamps[right] - stamps[left], 1)
        moved = invert(shape_left) @ self.shape.at(query)
        poses: FloatArray = self.anchors.poses[left] @ moved @ se3_exp(fraction[:, None] * miss)
        return poses
