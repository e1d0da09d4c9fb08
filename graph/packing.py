"""A message as bytes for another process of the same run: its large arrays in shared memory, the rest pickled.

Pickle is safe here, and only here: both ends are this program, and no one else can write to the pipe.
"""

from __future__ import annotations

import importlib
import io
import pickle
import struct
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any

import numpy as np

from mapstream.graph.ring import Region, RingReader, RingWriter, Span

_SMALL = 2048  # bytes; copying these with the rest costs less than a place of their own
_HEAD = struct.Struct("<hH")  # index of the region or -1, number of spans
_SPAN = struct.Struct("<QQ?")


class _Pickler(pickle.Pickler):
    """Names classes and dtypes by text, which is several times faster than pickle's own way."""

    def reducer_override(self, value: object) -> Any:  # noqa: ANN401  # as pickle says
        kind: Any = type(value)
        if kind is np.ndarray:
            return _reduce_array(value)
        names = _field_names(kind)
        if names is None:
            return NotImplemented
        return _message, (
            f"{kind.__module__}:{kind.__qualname__}",
            [getattr(value, n) for n in names],
        )


def _reduce_array(array: Any) -> Any:  # noqa: ANN401  # as pickle says
    if array.dtype.hasobject or array.dtype.names:
        return NotImplemented
    if array.flags.f_contiguous and not array.flags.c_contiguous:
        return NotImplemented
    plain = array
    if not array.flags.c_contiguous:  # gaps between its elements
        plain = np.ascontiguousarray(array)
        plain.flags.writeable = array.flags.writeable
    return _array, (pickle.PickleBuffer(plain), array.dtype.str, array.shape)


def _array(buffer: memoryview, dtype: str, shape: tuple[int, ...]) -> Any:  # noqa: ANN401
    return np.frombuffer(buffer, dtype).reshape(shape)


@cache
def _field_names(kind: type) -> tuple[str, ...] | None:
    """Return the fields of a dataclass that has nothing but them; None for all else."""
    if not is_dataclass(kind) or "__slots__" not in kind.__dict__:
        return None
    if kind.__reduce__ is not object.__reduce__ or kind.__reduce_ex__ is not object.__reduce_ex__:
        return None
    return tuple(field.name for field in fields(kind))


def _message(name: str, values: list[Any]) -> Any:  # noqa: ANN401  # of any class
    kind, names = _class(name)
    message: Any = object.__new__(kind)
    for field, value in zip(names, values, strict=True):
        object.__setattr__(message, field, value)
    return message


@cache
def _class(name: str) -> tuple[type, tuple[str, ...]]:
    module, _, path = name.partition(":")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    return found, tuple(field.name for field in fields(found))


def pack(message: object, ring: RingWriter) -> bytes:
    """Return the bytes that `unpack` understands; large arrays go through the ring if they fit."""
    buffers: list[memoryview] = []

    def stays_inside(buffer: pickle.PickleBuffer) -> bool:
        raw = buffer.raw()
        if raw.nbytes < _SMALL:
            return True
        buffers.append(raw)
        return False

    file = io.BytesIO()
    _Pickler(file, 5, buffer_callback=stays_inside).dump(message)
    region = ring.write(buffers) if buffers else None
    if buffers and region is None:  # no room: all of it through the pipe
        file = io.BytesIO()
        _Pickler(file, 5).dump(message)
    if region is None:
        return _HEAD.pack(-1, 0) + file.getbuffer()
    spans = [_SPAN.pack(s.start, s.size, s.is_read_only) for s in region.spans]
    return b"".join([_HEAD.pack(region.number, len(spans)), *spans, file.getbuffer()])


def unpack(data: memoryview, ring: RingReader) -> Any:  # noqa: ANN401  # any message
    """Return the message; its large arrays are views on the shared memory, read-only where they were."""
    index, num_spans = _HEAD.unpack_from(data)
    if index < 0:
        return pickle.loads(data[_HEAD.size :])  # noqa: S301  # written by our own process
    end = _HEAD.size + num_spans * _SPAN.size
    spans = tuple(Span(*fields) for fields in _SPAN.iter_unpack(data[_HEAD.size : end]))
    return pickle.loads(data[end:], buffers=ring.read(Region(index, spans)))  # noqa: S301  # the same
