"""Tables as Arrow IPC bytes; the schema derives from the declared columns.

Uncompressed on purpose: the bytes depend on no compressor's version, columns load as views of the mapped
file, and a file cannot unfold into more memory than its size (docs/decisions/0004).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from mapstream.recordings.maps.columns import Column, Table, TableT, columns_of


def arrow_schema(table_type: type[Table]) -> Any:  # noqa: ANN401  # pyarrow has no types
    """Return the pyarrow.Schema of a table."""
    fields = [pa.field(c.name, _arrow_type(c), nullable=False) for c in columns_of(table_type)]
    return pa.schema(fields)


def _arrow_type(column: Column) -> Any:  # noqa: ANN401
    if column.kind == "text":
        return pa.dictionary(pa.int32(), pa.utf8())
    if column.kind == "bytes":
        return pa.large_binary()
    if column.kind == "uint8" and len(column.shape) == 1:
        return pa.binary(column.shape[0])
    value = pa.from_numpy_dtype(np.dtype(column.kind))
    return pa.list_(value, math.prod(column.shape)) if column.shape else value


def write_table(table: Table) -> bytes:
    """Return the bytes of a table: the same table gives the same bytes."""
    table_type = type(table)
    arrays = [_arrow_array(c, getattr(table, c.name)) for c in columns_of(table_type)]
    batch = pa.RecordBatch.from_arrays(arrays, schema=arrow_schema(table_type))
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, batch.schema) as writer:
        writer.write_batch(batch)
    return bytes(memoryview(sink.getvalue()))


def _arrow_array(column: Column, values: npt.NDArray[Any]) -> Any:  # noqa: ANN401
    arrow_type = _arrow_type(column)
    if column.kind == "text":
        return pa.array(values, pa.utf8()).dictionary_encode()
    if column.kind == "bytes":
        return pa.array(values, arrow_type)
    values = np.ascontiguousarray(values)
    if pa.types.is_fixed_size_binary(arrow_type):
        return pa.FixedSizeBinaryArray.from_buffers(
            arrow_type, len(values), [None, pa.py_buffer(values)]
        )
    if column.shape:
        return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), type=arrow_type)
    return pa.array(values)


def mapped(file: Path) -> Any:  # noqa: ANN401  # pyarrow.Buffer
    """Return the bytes of a file, read from disk when they are looked at."""
    return pa.memory_map(str(file)).read_buffer()


def read_table(table_type: type[TableT], source: Any) -> TableT:  # noqa: ANN401  # pyarrow.Buffer
    """Return the table in these bytes; its numeric columns are views of them.

    Raises:
        ValueError: If the bytes are not a table of this type, or are damaged.
    """
    try:
        found = pa.ipc.open_file(source).read_all()
        found.validate(full=True)
    except (pa.ArrowException, OSError) as error:
        raise ValueError(str(error)) from error
    expected = arrow_schema(table_type)
    if not found.schema.equals(expected):
        raise ValueError(f"expected the columns {expected}, got {found.schema}")
    if any(column.null_count for column in found.columns):
        raise ValueError("values are missing")
    return table_type(
        **{c.name: _numpy(c, found[c.name].combine_chunks()) for c in columns_of(table_type)}
    )


def _numpy(column: Column, array: Any) -> npt.NDArray[Any]:  # noqa: ANN401
    if column.kind == "text":
        words = array.dictionary.to_numpy(zero_copy_only=False).astype(object)
        texts: npt.NDArray[Any] = words[array.indices.to_numpy(zero_copy_only=False)]
        return texts
    if pa.types.is_fixed_size_binary(array.type):
        data = np.frombuffer(array.buffers()[1] or b"", dtype=np.uint8).reshape(-1, *column.shape)
        return data[array.offset : array.offset + len(array)]
    flat = array.flatten() if column.shape else array
    values = np.asarray(flat.to_numpy(zero_copy_only=False), dtype=column.dtype)
    return values.reshape(len(array), *column.shape)
