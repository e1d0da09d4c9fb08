"""What logs of robots with a planar laser become: scans, wheel odometry, and where the laser sits."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np

from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.arrays import IntArray
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.sensors import TransformBatch, WheelOdometry

SCANS, WHEELS, PLACES = "/scan", "/odom", "/tf_static"
BASE, LASER = "base_link", "laser"


def planar_pose(x_m: float, y_m: float, yaw_rad: float) -> SE3:
    """Return the transform of a frame that lies flat in another."""
    return SE3.from_rotation(so3_exp([0.0, 0.0, yaw_rad]), [x_m, y_m, 0.0])


def wheel_odometry(stamp_ns: int, x_m: float, y_m: float, yaw_rad: float) -> WheelOdometry:
    """Return the robot's pose by its wheels as a message."""
    return WheelOdometry(stamp_ns=stamp_ns, T_odom_base=planar_pose(x_m, y_m, yaw_rad))


def write_place(writer: McapWriter, stamp_ns: int, T_base_laser: SE3) -> None:
    """Say once where the laser sits on the robot.

    Raises:
        RecordingError: If the disk is full.
    """
    place = TransformBatch(
        stamps_ns=np.array([stamp_ns]),
        parents=(BASE,),
        children=(LASER,),
        T_parent_child=T_base_laser.matrix[None],
        is_static=True,
    )
    writer.write(PLACES, place)


def repaired_stamps(stamps_ns: Sequence[int]) -> tuple[IntArray, int]:
    """Return stamps that increase, for lines whose order is right and some of whose stamps are not.

    The longest run of lines whose stamps increase keeps them; each line between two of these is placed evenly
    between. Also returned is the number of stamps that were changed.

    Source: of the longest run, Fredman, On computing the length of longest increasing subsequences, 1975.
    """
    given = np.asarray(stamps_ns, dtype=np.int64)
    if not len(given):
        return given, 0
    order, kept = np.arange(len(given)), _longest_increasing(given.tolist())
    since_ns = np.interp(order, kept, (given[kept] - given[0]).astype(np.float64))
    stamps = given[0] + np.round(since_ns).astype(np.int64)
    stamps = np.maximum.accumulate(stamps - order) + order  # lines beyond the run: 1 ns apart
    return stamps, len(given) - len(kept)


def _longest_increasing(values: list[int]) -> IntArray:
    """Return the indices of the longest run of values, not all neighbours, that strictly increases."""
    ends: list[int] = []  # the smallest value that ends a run of each length
    at_end: list[int] = []  # and its index
    before = [-1] * len(values)
    for at, value in enumerate(values):
        length = bisect_left(ends, value)
        before[at] = at_end[length - 1] if length else -1
        ends[length : length + 1] = [value]
        at_end[length : length + 1] = [at]
    run = [at_end[-1]] if at_end else []
    while run and before[run[-1]] >= 0:
        run.append(before[run[-1]])
    return np.array(run[::-1], dtype=np.int64)
