"""How the robot moved between two measurements, by the odometry around them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapstream.operators.operator import warn
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.trajectory import Trajectory


def moved(odometry: Sequence[Odometry], to_ns: int, from_ns: int) -> SE3:
    """Return T_to_from of the base; the identity where no odometry covers both."""
    if len(odometry) < 2 or to_ns == from_ns:
        return SE3.identity()
    path = Trajectory(
        stamps_ns=np.array([each.stamp_ns for each in odometry]),
        poses=np.array([each.T_odom_base.matrix for each in odometry]),
    )
    if not (path.covers(to_ns) and path.covers(from_ns)):
        warn("clouds and images beyond the odometry: the robot counts as standing between them")
        return SE3.identity()
    return path.pose_at(to_ns).inverse() @ path.pose_at(from_ns)
