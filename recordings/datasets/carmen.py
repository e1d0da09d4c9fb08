"""CARMEN logs (`.log`, `.clf`, also compressed with bzip2): a planar laser and wheel odometry, one message a line.

    FLASER n r1 .. rn  x y yaw  odom_x odom_y odom_yaw  ipc_stamp host logger_stamp
    ROBOTLASER1 type start_angle field_of_view angle_step max_range accuracy remission_mode  n r1 .. rn
        m e1 .. em  laser_x laser_y laser_yaw  robot_x robot_y robot_yaw  tv rv safety_front safety_side turn_axis
        ipc_stamp host logger_stamp
    ODOM x y yaw tv rv accel  ipc_stamp host logger_stamp
    PARAM name value ..

Laser lines carry the odometry of their own moment, which is what goes out; ODOM lines count where no laser line has
been. Lines are in the order in which things happened, but processes on other clocks gave the stamps: those that run
backwards are repaired. Where `NAME_gt.txt` (`line stamp x y yaw` with corrected poses; `line` counts laser lines) lies beside the log,
the poses go out at the repaired stamps of their lines.
Source: carmen.sourceforge.net, logger, "message formats"; Kummerle et al., On measuring the accuracy of SLAM
algorithms, AR 2009, for the corrected poses.
"""

from __future__ import annotations

import bz2
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
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
from mapstream.recordings.trajectory_files import read_corrected
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import LaserScan2D

TRUTH = "/truth"
_SICK_NOTHING_M = 80.0  # 81.83 and 81.91 m are codes for no return, and for dazzle


@dataclass(frozen=True, slots=True)
class _LaserLine:
    """What one line says."""

    stamp: float  # [s] as the line has it
    ranges_m: FloatArray  # (N,)
    start_rad: float
    step_rad: float
    max_range_m: float
    odom: FloatArray  # (3,) x, y, yaw of the robot
    T_base_laser: SE3 | None  # None: as the parameters say


def convert_carmen(source: Path, writer: McapWriter, on_progress: Progress) -> Notices:
    """Write `/scan`, `/odom`, the laser's place on `/tf_static`, and `/truth` where it is known."""
    lines, counts, front_m = _laser_lines(source)
    if not lines:
        found = ", ".join(f"{n} {name}" for name, n in sorted(counts.items())) or "nothing"
        raise RecordingError(f"{source}: expected FLASER or ROBOTLASER1 lines, found {found}")
    stamps_ns, num_repaired = repaired_stamps([round(line.stamp * 1e9) for line in lines])
    truth, notices = _truth(source, stamps_ns.tolist())
    place = lines[0].T_base_laser or planar_pose(front_m, 0.0, 0.0)
    write_place(writer, int(stamps_ns[0]), place)
    for index, (line, stamp_ns) in enumerate(zip(lines, stamps_ns.tolist(), strict=True)):
        writer.write(WHEELS, wheel_odometry(stamp_ns, *line.odom.tolist()))
        writer.write(SCANS, _scan(line, stamp_ns))
        if index in truth:
            writer.write(TRUTH, Odometry(stamp_ns=stamp_ns, T_odom_base=truth[index]))
        on_progress((index + 1) / len(lines))
    if num_repaired:
        notices += (f"{num_repaired} stamps of {len(lines)} that ran backwards were repaired",)
    lost = {name: n for name, n in sorted(counts.items()) if name not in _USED}
    notices += tuple(f"{n} lines {name} were left out" for name, n in lost.items())
    return notices


def _scan(line: _LaserLine, stamp_ns: int) -> LaserScan2D:
    seen = (line.ranges_m > 0) & (line.ranges_m < line.max_range_m)
    return LaserScan2D(
        stamp_ns=stamp_ns,
        ranges_m=np.where(seen, line.ranges_m, np.nan).astype(np.float32),
        angle_min_rad=line.start_rad,
        angle_step_rad=line.step_rad,
        range_min_m=0.0,
        range_max_m=line.max_range_m,
        frame=LASER,
    )


def _laser_lines(source: Path) -> tuple[list[_LaserLine], Counter[str], float]:
    """Return the laser lines that can be read, how many lines there are of each kind, and the laser's place."""
    found: list[_LaserLine] = []
    counts: Counter[str] = Counter()
    front_m = 0.0
    for text in _lines(source):
        words = text.split()
        if not words or words[0].startswith("#"):
            continue
        kind = words[0]
        try:
            if kind in _READERS:
                found.append(_READERS[kind](words))
            elif kind == "PARAM" and words[1] == "robot_frontlaser_offset":
                front_m = float(words[2])
            counts[kind] += 1
        except (ValueError, IndexError):
            counts["that cannot be read"] += 1
    return found, counts, front_m


def _lines(source: Path) -> Iterator[str]:
    open_text = bz2.open if source.suffix == ".bz2" else open
    try:
        with open_text(source, "rt", encoding="ascii", errors="replace") as lines:
            yield from lines
    except (OSError, EOFError) as error:
        raise RecordingError(f"{source}: cannot be read: {error}") from error


def _flaser(words: list[str]) -> _LaserLine:
    """Read half a circle of beams; CARMEN's odd counts include both ends, its even ones only the first."""
    num = int(words[1])
    rest = words[2 + num :]
    return _LaserLine(
        stamp=float(rest[6]),
        ranges_m=np.array(words[2 : 2 + num], np.float64),
        start_rad=-np.pi / 2,
        step_rad=np.pi / (num - num % 2),
        max_range_m=_SICK_NOTHING_M,
        odom=np.array(rest[3:6], np.float64),
        T_base_laser=None,
    )


def _robotlaser(words: list[str]) -> _LaserLine:
    num = int(words[8])
    rest = words[9 + num :]
    rest = rest[1 + int(rest[0]) :]  # remissions
    laser, robot = np.array(rest[:6], np.float64).reshape(2, 3)
    return _LaserLine(
        stamp=float(rest[11]),
        ranges_m=np.array(words[9 : 9 + num], np.float64),
        start_rad=float(words[2]),
        step_rad=float(words[4]),
        max_range_m=float(words[5]),
        odom=robot,
        T_base_laser=planar_pose(*robot).inverse() @ planar_pose(*laser),
    )


_READERS: dict[str, Callable[[list[str]], _LaserLine]] = {
    "FLASER": _flaser,
    "ROBOTLASER1": _robotlaser,
}
_USED = (*_READERS, "PARAM")


def _truth(source: Path, stamps_ns: list[int]) -> tuple[dict[int, SE3], Notices]:
    """Return corrected poses by the number of their laser line."""
    name = source.name.removesuffix(".bz2").removesuffix(source.suffix).split(".")[0]
    file = source.with_name(f"{name}_gt.txt")
    if not file.is_file():
        return {}, ()
    numbers, trajectory = read_corrected(file)
    poses = dict(zip(numbers.tolist(), map(SE3, trajectory.poses), strict=True))
    inside = {line: pose for line, pose in poses.items() if 0 <= line < len(stamps_ns)}
    num_outside = len(poses) - len(inside)
    notices = (f"{num_outside} corrected poses belong to no laser line",) if num_outside else ()
    return inside, notices
