"""CSV files whose header says what each column is: IMU, GNSS, odometry and positions as messages.

The stamp is `stamp_ns`, `stamp_us`, `stamp_ms` or `stamp_s`. A file holds one kind of measurement or several; a row
says nothing of a kind whose cells are empty in it.

| kind | columns | and, if known |
|---|---|---|
| imu | `gyro_x_radps` `accel_x_mps2` and y, z | |
| gnss | `latitude_deg` `longitude_deg` `altitude_m` | `sigma_east_m` `sigma_north_m` `sigma_up_m` |
| odometry | `x_m` `y_m` `z_m` `qx` `qy` `qz` `qw` | `vx_mps` `gyro_bias_x_radps` `accel_bias_x_mps2` and y, z; `sigma_rad` `sigma_m` of the step |
| position | `position_x_m` and y, z; `position_sigma_m` | |

Velocity is in the frame of the odometry. Positions are metres in an outer frame named `local`.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, OuterFrame
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import GnssFix, ImuBatch, Message

STAMPS = {"stamp_ns": 1, "stamp_us": 1_000, "stamp_ms": 1_000_000, "stamp_s": 1_000_000_000}
Cells = dict[str, float]  # of one row, by column


def _axes(name: str) -> tuple[str, ...]:
    return tuple(name.format(axis) for axis in "xyz")


@dataclass(frozen=True, slots=True)
class Kind:
    """What makes one kind of measurement."""

    topic: str
    needed: tuple[str, ...]
    groups: tuple[tuple[str, ...], ...]  # each there as a whole or not at all
    make: Callable[[int, Cells], Message]


def _vector(cells: Cells, names: tuple[str, ...]) -> FloatArray | None:
    return np.array([cells[name] for name in names]) if names[0] in cells else None


_GYRO, _ACCEL = _axes("gyro_{}_radps"), _axes("accel_{}_mps2")
_PLACE, _POSITION = _axes("{}_m"), _axes("position_{}_m")
_QUAT = ("qx", "qy", "qz", "qw")
_VELOCITY = _axes("v{}_mps")
_GYRO_BIAS, _ACCEL_BIAS = _axes("gyro_bias_{}_radps"), _axes("accel_bias_{}_mps2")
_STEP_SIGMAS = ("sigma_rad", "sigma_m")
_ENU_SIGMAS = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
_EARTH = ("latitude_deg", "longitude_deg", "altitude_m")


def _imu(stamp_ns: int, cells: Cells) -> ImuBatch:
    return ImuBatch(
        stamps_ns=np.array([stamp_ns]),
        gyro_radps=np.array([[cells[name] for name in _GYRO]]),
        accel_mps2=np.array([[cells[name] for name in _ACCEL]]),
    )


def _gnss(stamp_ns: int, cells: Cells) -> GnssFix:
    sigmas = _vector(cells, _ENU_SIGMAS)
    latitude, longitude, altitude = (cells[name] for name in _EARTH)
    return GnssFix(
        stamp_ns=stamp_ns,
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=altitude,
        covariance_enu_m2=None if sigmas is None else np.diag(sigmas**2),
    )


def _odometry(stamp_ns: int, cells: Cells) -> Odometry:
    sigmas = _vector(cells, _STEP_SIGMAS)
    place = [cells[name] for name in _PLACE]
    return Odometry(
        stamp_ns=stamp_ns,
        T_odom_base=SE3.from_quat_xyzw([cells[name] for name in _QUAT], place),
        covariance=None if sigmas is None else np.diag(np.repeat(sigmas**2, 3)),
        velocity_mps=_vector(cells, _VELOCITY),
        gyro_bias_radps=_vector(cells, _GYRO_BIAS),
        accel_bias_mps2=_vector(cells, _ACCEL_BIAS),
    )


def _position(stamp_ns: int, cells: Cells) -> Constraint:
    variance = cells["position_sigma_m"] ** 2
    return Constraint(
        stamp_ns=stamp_ns,
        kind="position",
        T_a_b=SE3.from_rotation(np.eye(3), [cells[name] for name in _POSITION]),
        covariance=np.diag([np.inf] * 3 + [variance] * 3),
        outer=OuterFrame(name="local"),
        source="csv",
    )


_POSE_GROUPS = (_VELOCITY, _GYRO_BIAS, _ACCEL_BIAS, _STEP_SIGMAS)
KINDS = {
    "imu": Kind("/imu", (*_GYRO, *_ACCEL), (), _imu),
    "gnss": Kind("/gnss", _EARTH, (_ENU_SIGMAS,), _gnss),
    "odometry": Kind("/odometry", (*_PLACE, *_QUAT), _POSE_GROUPS, _odometry),
    "position": Kind("/position", (*_POSITION, "position_sigma_m"), (), _position),
}


class ColumnFile:
    """A described CSV file; `unknown` names the columns that mean nothing here.

    Raises:
        RecordingError: If it cannot be read, or its header describes no measurement.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        try:
            self._lines = self.path.read_text(encoding="utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise RecordingError(f"{path}: cannot be read: {error}") from error
        header = next(csv.reader(self._lines[:1], skipinitialspace=True), [])
        self.columns = [name.strip().lstrip("#").strip() for name in header]
        stamps = [name for name in self.columns if name in STAMPS]
        if len(stamps) != 1 or len(set(self.columns)) != len(self.columns):
            found = ", ".join(self.columns) or "nothing"
            raise RecordingError(
                f"{path}:1: expected a header with one of {', '.join(STAMPS)}, each name once,"
                f" found {found}"
            )
        self._stamp = stamps[0]
        present = set(self.columns)
        self.kinds = {name: kind for name, kind in KINDS.items() if present >= set(kind.needed)}
        if not self.kinds:
            raise RecordingError(f"{path}:1: {_what_lacks(present)}")
        groups = {
            name: [g for g in k.groups if present >= set(g)] for name, k in self.kinds.items()
        }
        self._wanted = {name: (k.needed, groups[name]) for name, k in self.kinds.items()}
        used = {
            c for needed, extra in self._wanted.values() for part in (needed, *extra) for c in part
        }
        self.unknown = [name for name in self.columns if name not in used | {self._stamp}]

    def messages(self) -> Iterator[tuple[str, Message]]:
        """Yield topics and messages, in the order of the rows.

        Raises:
            RecordingError: If a row is not understood, or stamps do not increase; it has the line.
        """
        last_ns = dict.fromkeys(self.kinds, -1)
        rows = csv.reader(self._lines[1:], skipinitialspace=True)
        for number, row in enumerate(rows, start=2):
            if not row or row[0].startswith("#"):
                continue
            try:
                for name, stamp_ns, message in self._of_row(row):
                    _require_newer(stamp_ns, last_ns[name])
                    last_ns[name] = stamp_ns
                    yield KINDS[name].topic, message
            except (ValueError, InvalidOperation) as error:
                raise RecordingError(f"{self.path}:{number}: {error}") from error

    def _of_row(self, row: list[str]) -> Iterator[tuple[str, int, Message]]:
        if len(row) != len(self.columns):
            raise ValueError(f"expected {len(self.columns)} cells, found {len(row)}")
        texts = {name: text.strip() for name, text in zip(self.columns, row, strict=True)}
        stamp_ns = int((Decimal(texts[self._stamp]) * STAMPS[self._stamp]).to_integral_value())
        for name, (needed, groups) in self._wanted.items():
            if not any(texts[column] for column in needed):
                continue
            whole = [group for group in groups if any(texts[column] for column in group)]
            cells = {c: _number(c, texts[c]) for part in (needed, *whole) for c in part}
            yield name, stamp_ns, KINDS[name].make(stamp_ns, cells)


def _require_newer(stamp_ns: int, last_ns: int) -> None:
    if stamp_ns <= last_ns:
        raise ValueError(f"stamps must increase: {stamp_ns} after {last_ns} ns")


def _number(column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ValueError(f"{column}: expected a number, found {text!r}") from None
    if not np.isfinite(value):
        raise ValueError(f"{column}: expected a finite number, found {text!r}")
    return value


def _what_lacks(present: set[str]) -> str:
    """Say which columns are missing to the kind that the header is nearest to."""
    name, kind = max(KINDS.items(), key=lambda item: len(present & set(item[1].needed)))
    if not present & set(kind.needed):
        known = "; ".join(f"{name}: {' '.join(kind.needed)}" for name, kind in KINDS.items())
        return f"the header describes no measurement; known columns are {known}"
    missing = ", ".join(column for column in kind.needed if column not in present)
    return f"{name} needs the columns {missing} as well"
