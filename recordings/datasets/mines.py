"""The logs of Mines ParisTech that came with CoreSLAM: a Hokuyo URG-04LX and two wheel encoders.

A line holds a stamp [us], a number that is not used, the ticks of the left and the right wheel since the start, more that
is not used, and from field 24 on the ranges [mm] of 682 beams over 240 deg, counter-clockwise.
A wheel has a radius of 77 mm and turns once in 2000 ticks; the wheels are 330 mm apart; the laser sits 145 mm before
their axle. The 70 beams at either end see the robot itself.
Source: Steux and El Hamzaoui, CoreSLAM: a SLAM algorithm in less than 200 lines of C code, ICARCV 2010; the
description of the robot beside the logs (`mines.py`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapstream.recordings.datasets.conversion import Notices, Progress
from mapstream.recordings.datasets.planar_laser import (
    LASER,
    SCANS,
    WHEELS,
    planar_pose,
    repaired_stamps,
    wheel_odometry,
    write_place,
)
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.messages.sensors import LaserScan2D

_FIRST_BEAM, _NUM_BEAMS = 24, 682
_FIELD_OF_VIEW_RAD = np.radians(240)
_BLIND_BEAMS = 70  # at either end
_MIN_RANGE_M, _MAX_RANGE_M = 0.06, 4.0  # less is an error code
_LASER_BEFORE_AXLE_M = 0.145
_M_PER_TICK = 2 * np.pi * 0.077 / 2000
_TRACK_M = 0.330


def convert_mines(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write `/scan`, `/odom` and the laser's place on `/tf_static`."""
    rows, num_lost = _rows(source)
    stamps_ns, num_repaired = repaired_stamps((rows[:, 0].astype(np.int64) * 1000).tolist())
    write_place(writer, int(stamps_ns[0]), planar_pose(_LASER_BEFORE_AXLE_M, 0.0, 0.0))
    poses = dead_reckoned(rows[:, 2:4])
    for index, stamp_ns in enumerate(stamps_ns.tolist()):
        writer.write(WHEELS, wheel_odometry(stamp_ns, *poses[index].tolist()))
        writer.write(SCANS, _scan(stamp_ns, rows[index, _FIRST_BEAM:] / 1000))
        on_progress((index + 1) / len(rows))
    notices: Notices = ()
    if num_lost:
        notices += (f"{num_lost} lines that cannot be read were left out",)
    if num_repaired:
        notices += (f"{num_repaired} stamps of {len(rows)} that ran backwards were repaired",)
    return notices


def dead_reckoned(ticks: FloatArray) -> FloatArray:
    """Return the poses (N, 3) x, y, yaw of the axle's middle by ticks (N, 2) of the left and right wheel."""
    steps_m = np.diff(ticks, axis=0) * _M_PER_TICK
    turns = (steps_m[:, 1] - steps_m[:, 0]) / _TRACK_M
    yaw = np.concatenate([[0.0], np.cumsum(turns)])
    middle = yaw[:-1] + turns / 2  # the chord of an arc points half way between its ends
    ways = steps_m.mean(axis=1)[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    positions = np.concatenate([np.zeros((1, 2)), np.cumsum(ways, axis=0)])
    return np.concatenate([positions, yaw[:, None]], axis=1)


def _scan(stamp_ns: int, ranges_m: FloatArray) -> LaserScan2D:
    seen = (ranges_m > _MIN_RANGE_M) & (ranges_m < _MAX_RANGE_M)
    seen[:_BLIND_BEAMS] = seen[-_BLIND_BEAMS:] = False
    return LaserScan2D(
        stamp_ns=stamp_ns,
        ranges_m=np.where(seen, ranges_m, np.nan).astype(np.float32),
        angle_min_rad=-_FIELD_OF_VIEW_RAD / 2,
        angle_step_rad=_FIELD_OF_VIEW_RAD / (_NUM_BEAMS - 1),
        range_min_m=_MIN_RANGE_M,
        range_max_m=_MAX_RANGE_M,
        frame=LASER,
    )


def _rows(source: Path) -> tuple[FloatArray, int]:
    """Return the lines that can be read as numbers, and how many cannot."""
    try:
        lines = source.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError as error:
        raise RecordingError(f"{source}: cannot be read: {error}") from error
    rows, num_lost = [], 0
    for line in filter(str.strip, lines):
        try:
            row = np.array(line.split(), np.float64)[: _FIRST_BEAM + _NUM_BEAMS]
        except ValueError:
            row = np.empty(0)
        if len(row) == _FIRST_BEAM + _NUM_BEAMS and np.isfinite(row).all():
            rows.append(row)
        else:
            num_lost += 1
    if not rows:
        raise RecordingError(
            f"{source}: expected lines of {_FIRST_BEAM + _NUM_BEAMS} numbers, found none of"
            f" {num_lost}"
        )
    return np.array(rows), num_lost
