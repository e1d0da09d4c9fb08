"""Rows of tables: take some, put tables one after another, follow references. Knows no table by name."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.recordings.maps.columns import Column, Table, TableT, columns_of, references_of
from mapstream.streams.arrays import BoolArray, IntArray


def take(table: TableT, rows: npt.NDArray[np.integer[Any]] | BoolArray) -> TableT:
    """Return the rows of these numbers, or where the mask is true."""
    return type(table)(**{c.name: getattr(table, c.name)[rows] for c in columns_of(type(table))})


def concatenate(tables: Sequence[TableT]) -> TableT:
    """Return one table with the rows of all; references are not touched."""
    if len(tables) == 1:
        return tables[0]
    columns = columns_of(type(tables[0]))
    joined = {c.name: np.concatenate([getattr(t, c.name) for t in tables]) for c in columns}
    return type(tables[0])(**joined)


def shifted(table: TableT, num_rows: Mapping[str, int]) -> TableT:
    """Return the table with references moved on by the rows that now come before, per table."""
    moved = {}
    for column in references_of(type(table)):
        rows = getattr(table, column.name)
        moved[column.name] = np.where(rows < 0, rows, rows + num_rows[str(column.refers_to)])
    return replace(table, **moved) if moved else table


def select(tables: Mapping[str, Table], keep: Mapping[str, BoolArray]) -> dict[str, Table]:
    """Return the tables with the rows where `keep` is true, less those that refer to a dropped row.

    Args:
        tables: By name, each after those that it refers to.
        keep: Masks by table; a table without one keeps every row that may stay.

    Raises:
        ValueError: If there is no such table, or a mask is not as long as its table.
    """
    for name, mask in keep.items():
        if name not in tables or len(mask) != len(tables[name]):
            lengths = {each: len(table) for each, table in tables.items()}
            raise ValueError(f"a mask of {len(mask)} rows for {name}; the tables have {lengths}")
    selected: dict[str, Table] = {}
    new_rows: dict[str, IntArray] = {}  # by table: the new number of each row, -1 where dropped
    for name, table in tables.items():
        stays = np.array(keep.get(name, np.ones(len(table), dtype=bool)), dtype=bool)
        renumbered: dict[str, IntArray] = {}
        for column in references_of(type(table)):
            rows = getattr(table, column.name)
            renumbered[column.name] = np.where(
                rows < 0, rows, np.append(new_rows[str(column.refers_to)], -1)[rows]
            )
            stays &= (renumbered[column.name] >= 0) | (rows < 0)
        new_rows[name] = np.where(stays, np.cumsum(stays) - 1, -1)
        moved = replace(table, **renumbered) if renumbered else table
        selected[name] = moved if stays.all() else take(moved, stays)  # whole columns are shared
    return selected


def table_digest(table: Table) -> bytes:
    """Return a hash of the values alone, free of how memory or files lay them out."""
    digest = hashlib.blake2b(digest_size=32)
    for column in columns_of(type(table)):
        digest.update(f"{column.name}:{column.kind}:{column.shape}:{len(table)};".encode())
        for chunk in _canonical(column, getattr(table, column.name)):
            digest.update(chunk)
    return digest.digest()


def _canonical(column: Column, values: npt.NDArray[Any]) -> Sequence[bytes | memoryview]:
    """Return little-endian C-ordered bytes; of texts and byte strings, their lengths come first."""
    if column.kind in ("text", "bytes"):
        parts = [v.encode() if isinstance(v, str) else v for v in values]
        lengths = np.fromiter(map(len, parts), dtype="<i8", count=len(parts))
        return [lengths.tobytes(), b"".join(parts)]
    little = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    return [little.reshape(-1).view(np.uint8).data]
