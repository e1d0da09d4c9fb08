"""Odometry from a text file of any known layout; the first line says which.

| a line | layout | has besides poses |
|---|---|---|
| 8 numbers | TUM | |
| 12 numbers | KITTI | |
| 17 or more, with commas | EuRoC states | velocity, biases |
| 8 or more, with commas | EuRoC poses | |
| a header with a stamp's column | described CSV, see `column_files.py` | what its columns say |
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mapstream.recordings.column_files import KINDS, ColumnFile
from mapstream.recordings.number_tables import read_stamped_table
from mapstream.recordings.trajectory_files import read_euroc, read_kitti, read_tum
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.trajectory import Trajectory

_NUM_STATE = 16  # numbers of a EuRoC state behind its stamp: p, q, v, gyro bias, accelerometer bias


def read_odometry(path: Path | str) -> list[Odometry]:
    """Read a file's poses, in the order of their stamps, which increase.

    Raises:
        RecordingError: If it cannot be read, holds no poses, or a line is wrong; with the line.
    """
    path = Path(path)
    header, line = _first_lines(path)
    if "stamp_" in header:
        return _of_columns(path)
    words = line.split("," if "," in line else None)
    if "," in line and len(words) > _NUM_STATE:
        return _of_states(path)
    if "," in line and len(words) >= 8:
        return _of_trajectory(read_euroc(path))
    if len(words) == 8:
        return _of_trajectory(read_tum(path))
    if len(words) == 12:
        return _of_trajectory(read_kitti(path))
    raise RecordingError(
        f"{path}: no odometry: expected 8 numbers a line (TUM), 12 (KITTI), commas (EuRoC) or a header"
        f" that names its columns, found {line[:60]!r}"
    )


def _first_lines(path: Path) -> tuple[str, str]:
    """Return the first line, and the first one that is neither empty nor a comment."""
    try:
        with path.open(encoding="utf-8-sig") as lines:
            header = line = lines.readline()
            while line and (not line.strip() or line.startswith("#")):
                line = lines.readline()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read as text: {error}") from error
    return header, line.strip()


def _of_trajectory(trajectory: Trajectory) -> list[Odometry]:
    rows = zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True)
    return [Odometry(stamp_ns=stamp_ns, T_odom_base=SE3(T)) for stamp_ns, T in rows]


def _of_columns(path: Path) -> list[Odometry]:
    file = ColumnFile(path)
    if "odometry" not in file.kinds:
        needed = ", ".join(KINDS["odometry"].needed)
        raise RecordingError(f"{path}:1: no odometry: it needs the columns {needed}")
    return [message for _, message in file.messages() if isinstance(message, Odometry)]


def _of_states(path: Path) -> list[Odometry]:
    stamps_ns, values = read_stamped_table(path, _NUM_STATE, separator=",")
    return [
        Odometry(
            stamp_ns=stamp_ns,
            T_odom_base=SE3.from_quat_xyzw(np.roll(row[3:7], -1), row[:3]),
            velocity_mps=row[7:10],
            gyro_bias_radps=row[10:13],
            accel_bias_mps2=row[13:16],
        )
        for stamp_ns, row in zip(stamps_ns.tolist(), values, strict=True)
    ]
