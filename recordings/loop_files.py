"""Loop closures in a file, as other programs find them: between two instants, of one mission or of two.

YAML, with a covariance (6, 6), rotation first, or two standard deviations:

    loops:
      - mission_a: 0f3c          # the id, its first digits, or the name of a mission
        stamp_a_ns: 1403715524912143104
        mission_b: 77aa
        stamp_b_ns: 1403715604512143104
        T_a_b: [1.2, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0]   # x y z [m], qx qy qz qw
        rotation_sigma_rad: 0.01
        translation_sigma_m: 0.05

CSV, with these columns by name: mission_a, stamp_a_ns, mission_b, stamp_b_ns, x, y, z, qx, qy, qz, qw,
rotation_sigma_rad, translation_sigma_m. Stamps are integers. An optimizer may find that a loop is false.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError, RecordingError
from mapstream.streams.fields import Fields
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import RelativePose

SUFFIXES = (".yaml", ".yml", ".csv")
_COLUMNS = (
    *("mission_a", "stamp_a_ns", "mission_b", "stamp_b_ns"),
    *("x", "y", "z", "qx", "qy", "qz", "qw", "rotation_sigma_rad", "translation_sigma_m"),
)


def read_loops(path: Path) -> list[RelativePose]:
    """Read loop closures; missions are named as in the file.

    Raises:
        RecordingError: If the file cannot be read, or a value is missing or wrong; it names the line.
        ConfigError: If a YAML file has such a mistake.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise RecordingError(f"{path}: loops come as {', '.join(SUFFIXES)}, not {path.suffix!r}")
    return _read_csv(path) if path.suffix.lower() == ".csv" else _read_yaml(path)


def _read_yaml(path: Path) -> list[RelativePose]:
    file = Fields.of_file(path)
    loops = []
    for entry in file.items("loops"):
        T_a_b = entry.vector("T_a_b")
        if len(T_a_b) != 7 or not np.any(T_a_b[3:]):
            raise entry.error("T_a_b", "expected x y z qx qy qz qw")
        if "covariance" in entry:
            covariance = entry.matrix("covariance", (6, 6))
        else:
            sigmas = entry.number("rotation_sigma_rad"), entry.number("translation_sigma_m")
            covariance = _diagonal(*sigmas)
        if not np.all(np.linalg.eigvalsh(covariance) > 0):
            raise entry.error("covariance", "expected a positive definite covariance, or sigmas")
        loops.append(
            RelativePose(
                kind="loop",
                mission_a=entry.text("mission_a"),
                stamp_a_ns=entry.integer("stamp_a_ns"),
                mission_b=entry.text("mission_b"),
                stamp_b_ns=entry.integer("stamp_b_ns"),
                T_a_b=SE3.from_quat_xyzw(T_a_b[3:], T_a_b[:3]),
                covariance=covariance,
                source=entry.text("source", path.name),
                is_switchable=True,
            )
        )
        _require_all_read(entry)
    _require_all_read(file)
    return loops


def _require_all_read(fields: Fields) -> None:
    if unread := fields.unread():
        raise ConfigError(f"{unread[0]}: unknown key")


def _read_csv(path: Path) -> list[RelativePose]:
    try:
        with path.open(encoding="utf-8", newline="") as lines:
            table = csv.DictReader(lines, skipinitialspace=True)
            if missing := set(_COLUMNS) - set(table.fieldnames or ()):
                raise RecordingError(f"{path}: line 1 has no column {', '.join(sorted(missing))}")
            return [_of_row(row, path, table.line_num) for row in table]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error


def _of_row(row: dict[str, str], path: Path, line: int) -> RelativePose:
    try:
        numbers = np.array([float(row[name]) for name in _COLUMNS[4:]])
        stamps_ns = int(row["stamp_a_ns"]), int(row["stamp_b_ns"])
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{path}:{line}: {error}") from None
    if not np.isfinite(numbers).all() or not np.any(numbers[3:7]) or min(numbers[7:]) <= 0:
        raise RecordingError(f"{path}:{line}: expected finite numbers, a rotation, sigmas above 0")
    return RelativePose(
        kind="loop",
        mission_a=row["mission_a"],
        stamp_a_ns=stamps_ns[0],
        mission_b=row["mission_b"],
        stamp_b_ns=stamps_ns[1],
        T_a_b=SE3.from_quat_xyzw(numbers[3:7], numbers[:3]),
        covariance=_diagonal(numbers[7], numbers[8]),
        source=path.name,
        is_switchable=True,
    )


def _diagonal(rotation_sigma_rad: float, translation_sigma_m: float) -> FloatArray:
    return np.diag(np.repeat([rotation_sigma_rad, translation_sigma_m], 3) ** 2)
