"""Trajectories as text: TUM, KITTI, EuRoC and corrected laser logs, with stamps exact to the nanosecond.

| format | a line | stamps |
|---|---|---|
| TUM | `stamp tx ty tz qx qy qz qw` | seconds |
| KITTI | the first three rows of the pose, row by row | none; a `times.txt` beside it may have them |
| EuRoC | `stamp,px,py,pz,qw,qx,qy,qz` and more columns, which are ignored | nanoseconds |
| corrected laser log | `line stamp x y yaw`, where `line` counts the log's laser lines from 0 | seconds |
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path

import numpy as np

from mapstream.recordings.maps.folder import write_whole
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import (
    SE3,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
    se3_exp,
)
from mapstream.streams.trajectory import Trajectory

KITTI_PERIOD_NS = 100_000_000  # nominal, for poses without a file of times


class _Line:
    """The fields of one line, and where it stands, for messages."""

    def __init__(self, path: Path, number: int, text: str, separator: str | None) -> None:
        self.place = f"{path}:{number}"
        self.fields = [field.strip() for field in text.split(separator)]

    def floats(self, fields: Sequence[str]) -> FloatArray:
        try:
            values = np.array([float(field) for field in fields])
        except ValueError as error:
            raise RecordingError(f"{self.place}: expected numbers, found {fields}") from error
        if not np.isfinite(values).all():
            raise RecordingError(f"{self.place}: expected finite numbers, found {fields}")
        return values

    def stamp_ns(self, unit_ns: int, field: int = 0) -> int:
        """Return a field as nanoseconds, without a detour through floats."""
        try:
            return int((Decimal(self.fields[field]) * unit_ns).to_integral_value())
        except (InvalidOperation, ValueError, OverflowError) as error:
            raise RecordingError(
                f"{self.place}: expected a stamp, found {self.fields[field]!r}"
            ) from error

    def pose(self, t: Sequence[str], quat_xyzw: Sequence[str]) -> FloatArray:
        """Return a pose (4, 4)."""
        T = np.eye(4)
        T[:3, 3] = self.floats(t)
        try:
            T[:3, :3] = rotation_from_quat_xyzw(self.floats(quat_xyzw))
        except ValueError as error:
            raise RecordingError(f"{self.place}: {error}") from error
        return T


def read_tum(path: str | Path) -> Trajectory:
    """Read a TUM file.

    Raises:
        RecordingError: If it is absent, or a line is not what it should be; with the line.
    """
    return _read_stamped(Path(path), None, 10**9, lambda f: (f[1:4], f[4:8]))


def read_euroc(path: str | Path) -> Trajectory:
    """Read a EuRoC ground truth file (`state_groundtruth_estimate0/data.csv`).

    Raises:
        RecordingError: If it is absent, or a line is not what it should be; with the line.
    """
    return _read_stamped(Path(path), ",", 1, lambda f: (f[1:4], [*f[5:8], f[4]]))


def read_kitti(path: str | Path, times: str | Path | None = None) -> Trajectory:
    """Read a KITTI pose file.

    Args:
        path: The poses.
        times: A file with one stamp [s] per pose; without one, poses are 0.1 s apart from zero on.

    Raises:
        RecordingError: If a file is absent, a line is not what it should be, or the counts differ.
    """
    path, poses = Path(path), []
    for line in _lines(path, None, 12):
        T = np.vstack([line.floats(line.fields).reshape(3, 4), [0, 0, 0, 1]])
        try:
            poses.append(SE3(T).matrix)
        except ValueError as error:
            raise RecordingError(f"{line.place}: {error}") from error
    if times is None:
        stamps_ns = np.arange(len(poses)) * KITTI_PERIOD_NS
    else:
        stamps_ns = read_times(times)
        if len(stamps_ns) != len(poses):
            found = f"{len(stamps_ns)} times in {times}"
            raise RecordingError(
                f"{path}: expected as many times as poses, {len(poses)}, found {found}"
            )
    return Trajectory(stamps_ns=stamps_ns, poses=np.array(poses).reshape(-1, 4, 4))


def read_corrected(path: str | Path) -> tuple[IntArray, Trajectory]:
    """Read the corrected poses of a laser log; return the laser lines (N,) that they belong to, and the poses.

    Raises:
        RecordingError: If the file is absent, or a line is not what it should be; with the line.
    """
    lines = list(_lines(Path(path), None, 5))
    numbers = np.array([line.floats(line.fields[:1]) for line in lines]).reshape(-1)
    stamps = [line.stamp_ns(10**9, field=1) for line in lines]
    x, y, yaw = np.array([line.floats(line.fields[2:5]) for line in lines]).reshape(-1, 3).T
    poses = se3_exp(np.stack([0 * x, 0 * x, yaw, 0 * x, 0 * x, 0 * x], axis=-1))
    poses[:, 0, 3], poses[:, 1, 3] = x, y
    trajectory = Trajectory(stamps_ns=_increasing(lines, stamps), poses=poses)
    return numbers.astype(np.int64), trajectory


def read_times(path: str | Path) -> IntArray:
    """Read increasing stamps [ns] from a file with one number [s] per line.

    Raises:
        RecordingError: If it is absent, or a line is not what it should be.
    """
    lines = list(_lines(Path(path), None, 1))
    return _increasing(lines, [line.stamp_ns(10**9) for line in lines])


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a TUM file, whole or not at all.

    Raises:
        RecordingError: If the disk refuses.
    """
    quat_xyzw = quat_xyzw_from_rotation(trajectory.poses[:, :3, :3])
    rows = np.concatenate([trajectory.poses[:, :3, 3], quat_xyzw], axis=1)
    stamps = (f"{ns // 10**9}.{ns % 10**9:09d}" for ns in trajectory.stamps_ns.tolist())
    _write(Path(path), ("# stamp tx ty tz qx qy qz qw", *_joined(stamps, rows, " ")))


def write_euroc(path: str | Path, trajectory: Trajectory) -> None:
    """Write a EuRoC file with poses only, whole or not at all.

    Raises:
        RecordingError: If the disk refuses.
    """
    quat_xyzw = quat_xyzw_from_rotation(trajectory.poses[:, :3, :3])
    rows = np.concatenate([trajectory.poses[:, :3, 3], np.roll(quat_xyzw, 1, axis=1)], axis=1)
    header = "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []"
    _write(Path(path), (header, *_joined(map(str, trajectory.stamps_ns.tolist()), rows, ",")))


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write a KITTI pose file, whole or not at all; it holds no stamps.

    Raises:
        RecordingError: If the disk refuses.
    """
    rows = trajectory.poses[:, :3].reshape(-1, 12)
    _write(Path(path), (" ".join(map(_number, row)) for row in rows.tolist()))


def _read_stamped(
    path: Path,
    separator: str | None,
    unit_ns: int,
    columns: Callable[[Sequence[str]], tuple[Sequence[str], Sequence[str]]],
) -> Trajectory:
    lines = list(_lines(path, separator, 8))
    stamps_ns = _increasing(lines, [line.stamp_ns(unit_ns) for line in lines])
    poses = [line.pose(*columns(line.fields)) for line in lines]
    return Trajectory(stamps_ns=stamps_ns, poses=np.array(poses).reshape(-1, 4, 4))


def _increasing(lines: Sequence[_Line], stamps_ns: Sequence[int]) -> IntArray:
    for line, (before, after) in zip(lines[1:], pairwise(stamps_ns), strict=True):
        if after <= before:
            raise RecordingError(
                f"{line.place}: stamps must increase, found {after} after {before} ns"
            )
    return np.array(stamps_ns, dtype=np.int64)


def _lines(path: Path, separator: str | None, num_fields: int) -> Iterable[_Line]:
    """Yield the lines that are neither empty nor comments."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read as a trajectory: {error}") from error
    for number, content in enumerate(text.splitlines(), start=1):
        if not content.strip() or content.lstrip().startswith("#"):
            continue
        line = _Line(path, number, content, separator)
        if len(line.fields) < num_fields:
            found = f"{len(line.fields)}: {content.strip()[:60]!r}"
            raise RecordingError(f"{line.place}: expected {num_fields} numbers, found {found}")
        yield line


def _joined(stamps: Iterable[str], rows: FloatArray, separator: str) -> Iterable[str]:
    for stamp, row in zip(stamps, rows.tolist(), strict=True):
        yield separator.join([stamp, *map(_number, row)])


def _number(value: float) -> str:
    return f"{value:.12f}"


def _write(path: Path, lines: Iterable[str]) -> None:
    text = "".join(f"{line}\n" for line in lines)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text.encode())
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error}") from error
