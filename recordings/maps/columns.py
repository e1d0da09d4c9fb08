"""What a table of a map is: columns of equal length, each declared with its type, shape and meaning."""

# `column` makes a dataclass field, which the rule cannot see

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import frozen

IdArray = npt.NDArray[np.uint8]
TextArray = npt.NDArray[np.object_]  # of str
BytesArray = npt.NDArray[np.object_]  # of bytes


@dataclass(frozen=True, slots=True)
class Column:
    """What one column of a table holds."""

    name: str
    kind: str  # "text", "bytes", or the name of a numpy type
    shape: tuple[int, ...]  # of one row
    meaning: str
    refers_to: str | None  # the table whose rows these numbers are
    is_optional: bool  # a reference that may be -1
    fill: Any  # the value of every row where a table is made without this column; None: required

    @property
    def dtype(self) -> npt.DTypeLike:
        return np.dtype(object if self.kind in ("text", "bytes") else self.kind)


def column(
    kind: str,
    meaning: str,
    shape: tuple[int, ...] = (),
    *,
    refers_to: str | None = None,
    is_optional: bool = False,
    fill: Any = None,  # noqa: ANN401  # a value of the column's type
) -> Any:  # noqa: ANN401  # stands for the annotated array
    """Declare a column; what the arguments mean stands at `Column`."""
    declared = Column("", kind, shape, meaning, refers_to, is_optional, fill)
    return field(default=None, metadata={"column": declared})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Table:
    """Columns of equal length; read-only. A column that is not given gets its fill value."""

    meaning: ClassVar[str] = ""

    def __post_init__(self) -> None:
        columns = columns_of(type(self))
        given = [c.name for c in columns if getattr(self, c.name) is not None]
        num_rows = len(getattr(self, given[0])) if given else 0
        for column in columns:
            if getattr(self, column.name) is None:
                object.__setattr__(self, column.name, self._filled(column, num_rows))
            frozen(self, column.name, column.dtype, (num_rows, *column.shape))
            self._check_objects(column)

    def _filled(self, column: Column, num_rows: int) -> npt.NDArray[Any]:
        if column.fill is None and num_rows:
            raise ValueError(f"{type(self).__name__}: the column {column.name} is missing")
        fill = 0 if column.fill is None else column.fill
        return np.full((num_rows, *column.shape), fill, column.dtype)

    def _check_objects(self, column: Column) -> None:
        expected = {"text": str, "bytes": bytes}.get(column.kind)
        found = set(map(type, getattr(self, column.name))) if expected else set()
        if not found <= {expected}:
            names = sorted(kind.__name__ for kind in found)
            raise ValueError(
                f"{type(self).__name__}.{column.name}: expected {expected}, got {names}"
            )

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))


TableT = TypeVar("TableT", bound=Table)


_columns: dict[type, tuple[Column, ...]] = {}  # read once: every table that is made asks


def columns_of(table_type: type[Table]) -> tuple[Column, ...]:
    """Return the declared columns of a table type, in their order."""
    columns = _columns.get(table_type)
    if columns is None:
        columns = tuple(replace(f.metadata["column"], name=f.name) for f in fields(table_type))
        _columns[table_type] = columns
    return columns


def references_of(table_type: type[Table]) -> tuple[Column, ...]:
    """Return the columns of a table type that refer to rows of a table."""
    return tuple(column for column in columns_of(table_type) if column.refers_to is not None)
