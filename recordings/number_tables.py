"""Text files with one row of numbers per line, read fast, with errors that name the line."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import RecordingError


def read_table(
    path: Path, num_columns: int, *, separator: str | None = None, header: int = 0
) -> FloatArray:
    """Read finite numbers (N, num_columns), N >= 1, after lines of header; `#` begins a comment.

    Args:
        path: The file.
        num_columns: How many a line has at least; more are ignored.
        separator: Between numbers; white space by default.
        header: Lines to skip.

    Raises:
        RecordingError: If the file cannot be read, or a line is something else.
    """
    numbers = _load(path, np.dtype([("", np.float64)] * num_columns), separator, header)
    rows = np.column_stack([numbers[name] for name in numbers.dtype.names or ()])
    _require_finite(path, rows)
    return rows


def read_stamped_table(
    path: Path, num_columns: int, *, separator: str | None = None
) -> tuple[IntArray, FloatArray]:
    """Read stamps (N,) that are whole nanoseconds, and the finite numbers after them (N, num_columns).

    Raises:
        RecordingError: If the file cannot be read, a line is something else, or stamps do not increase.
    """
    layout = np.dtype([("stamp_ns", np.int64)] + [(f"{i}", np.float64) for i in range(num_columns)])
    rows = _load(path, layout, separator, 0)
    values = np.column_stack([rows[f"{i}"] for i in range(num_columns)])
    _require_finite(path, values)
    stamps_ns: IntArray = rows["stamp_ns"].astype(np.int64)
    backwards = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(backwards):
        row = int(backwards[0]) + 1
        found = f"{stamps_ns[row]} after {stamps_ns[row - 1]} ns"
        raise RecordingError(f"{path}: row {row + 1}: stamps must increase, found {found}")
    return stamps_ns, values


def _load(
    path: Path, layout: np.dtype[np.void], separator: str | None, header: int
) -> npt.NDArray[np.void]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty file is our error, not numpy's warning
            columns = range(len(layout.names or ()))
            rows: npt.NDArray[np.void] = np.loadtxt(
                path, layout, delimiter=separator, skiprows=header, usecols=columns, ndmin=1
            )
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: cannot be read: {error}") from error
    except ValueError as error:
        raise RecordingError(f"{path}: expected rows of numbers: {error}") from error
    if not rows.size:
        raise RecordingError(f"{path}: expected rows of numbers, found none")
    return rows


def _require_finite(path: Path, rows: FloatArray) -> None:
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise RecordingError(
            f"{path}: row {bad[0] + 1}: expected finite numbers, found {rows[bad[0]]}"
        )
