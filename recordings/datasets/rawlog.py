"""MRPT rawlogs (`.rawlog`, compressed with gzip or not): planar laser scans and wheel odometry.

Increments of odometry are added up; poses of odometry go out as they are.
"""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

import numpy as np

from mapstream.recordings.datasets.conversion import Notices, Progress
from mapstream.recordings.datasets.mrpt_archive import Archive, MotionStep, RangeScan
from mapstream.recordings.datasets.planar_laser import (
    LASER,
    SCANS,
    WHEELS,
    planar_pose,
    repaired_stamps,
    write_place,
)
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import LaserScan2D, Message, WheelOdometry


def convert_rawlog(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write `/scan`, `/odom` and the laser's place on `/tf_static`."""
    archive = Archive(_content(source))
    problem = archive.read()
    scans = archive.scans
    notices: Notices = (problem,) if problem else ()
    if not scans:
        raise RecordingError(f"{source}: expected planar scans, found none; {problem}")
    stamps_ns, num_repaired = repaired_stamps([scan.stamp_ns for scan in scans])
    messages: list[tuple[int, str, Message]] = list(_wheels(archive.steps))
    for stamp_ns, scan in zip(stamps_ns.tolist(), scans, strict=True):
        messages.append((stamp_ns, SCANS, _message(scan, stamp_ns)))
    messages.sort(key=lambda item: item[0])
    write_place(writer, messages[0][0], scans[0].T_base_laser)
    for index, (_, topic, message) in enumerate(messages):
        writer.write(topic, message)
        on_progress((index + 1) / len(messages))
    if num_repaired:
        notices += (f"{num_repaired} stamps of {len(scans)} that ran backwards were repaired",)
    return notices


def _wheels(steps: list[MotionStep]) -> list[tuple[int, str, Message]]:
    """Return the wheel odometry: increments added up, poses as they are."""
    if not steps:
        return []
    stamps_ns, _ = repaired_stamps([step.stamp_ns for step in steps])
    T_odom_base = SE3.identity()
    found: list[tuple[int, str, Message]] = []
    for stamp_ns, step in zip(stamps_ns.tolist(), steps, strict=True):
        motion = planar_pose(*step.motion)
        T_odom_base = motion if step.is_absolute else T_odom_base @ motion
        found.append((stamp_ns, WHEELS, WheelOdometry(stamp_ns=stamp_ns, T_odom_base=T_odom_base)))
    return found


def _message(scan: RangeScan, stamp_ns: int) -> LaserScan2D:
    step = scan.aperture_rad / max(len(scan.ranges_m) - 1, 1)
    direction = 1.0 if scan.is_counter_clockwise else -1.0
    return LaserScan2D(
        stamp_ns=stamp_ns,
        ranges_m=scan.ranges_m.astype(np.float32),
        angle_min_rad=-direction * scan.aperture_rad / 2,
        angle_step_rad=direction * step,
        range_min_m=0.0,
        range_max_m=scan.max_range_m,
        frame=LASER,
    )


def _content(source: Path) -> bytes:
    try:
        content = source.read_bytes()
        return gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content
    except (OSError, EOFError, zlib.error) as error:
        raise RecordingError(f"{source}: cannot be read: {error}") from error
