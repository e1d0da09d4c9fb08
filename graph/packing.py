"""A message as bytes for another process of the same run: its large arrays in shared memory, the rest pickled.

Messages and arrays are taken apart first, so that pickle sees numbers and text: naming classes and dtypes
its own way takes several times longer. What is neither is left to it.
Pickle is safe here, and only here: both ends are this program, and no one else can write to the pipe.
"""

from __future__ import annotations

import importlib
import pickle
import struct
import sys
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.graph.ring import Region, RingReader, RingWriter, Span

_SMALL = 2048  # bytes; copying these with the rest costs less than a place of their own
_HEAD = struct.Struct("<hH")  # number of the region or -1, number of spans
_SPAN = struct.Struct("<QQ?")
# The first item of a tuple says what was taken apart: a tuple, a message, an array in the ring or here.
_TUPLE, _MESSAGE, _PLACED, _INSIDE = range(4)


def pack(message: object, ring: RingWriter) -> bytes:
    """Return the bytes that `unpack` understands; large arrays go through the ring if they fit."""
    arrays: list[npt.NDArray[Any]] = []
    parts = _take_apart(message, arrays, _SMALL)
    region = ring.write(arrays) if arrays else None
    if region is None:
        if arrays:  # no room: all of it through the pipe
            parts = _take_apart(message, arrays, sys.maxsize)
        return _HEAD.pack(-1, 0) + pickle.dumps(parts)
    spans = [_SPAN.pack(*span) for span in region.spans]
    return b"".join([_HEAD.pack(region.number, len(spans)), *spans, pickle.dumps(parts)])


def unpack(data: memoryview, ring: RingReader) -> Any:  # noqa: ANN401  # any message
    """Return the message; its large arrays are views on the shared memory, read-only where they were."""
    number, num_spans = _HEAD.unpack_from(data)
    end = _HEAD.size + num_spans * _SPAN.size
    spans = tuple(Span(*part) for part in _SPAN.iter_unpack(data[_HEAD.size : end]))
    places = ring.read(Region(number, spans)) if spans else []
    return _put_together(pickle.loads(data[end:]), places)  # noqa: S301  # written by our own process


def _take_apart(value: Any, arrays: list[npt.NDArray[Any]], small: int) -> Any:  # noqa: ANN401
    """Return a tree that pickles fast; arrays from `small` bytes on are put into the list."""
    kind: Any = type(value)
    if kind is np.ndarray:
        return _take_array(value, arrays, small)
    if kind is tuple:
        return (_TUPLE, *[_take_apart(item, arrays, small) for item in value])
    names = _field_names(kind)
    if names is None:
        return value
    parts = [_take_apart(getattr(value, name), arrays, small) for name in names]
    return (_MESSAGE, f"{kind.__module__}:{kind.__qualname__}", *parts)


def _take_array(array: npt.NDArray[Any], arrays: list[npt.NDArray[Any]], small: int) -> Any:  # noqa: ANN401
    dtype = array.dtype
    if dtype.hasobject or dtype.names:
        return array
    if array.nbytes < small:
        data = array.tobytes()
        return _INSIDE, dtype.str, array.shape, bytearray(data) if array.flags.writeable else data
    arrays.append(array)
    return _PLACED, dtype.str, array.shape, len(arrays) - 1


def _put_together(parts: Any, places: list[npt.NDArray[np.uint8]]) -> Any:  # noqa: ANN401
    if type(parts) is not tuple:
        return parts
    match parts:
        case (what, name, *values) if what == _MESSAGE:
            kind, names = _class(name)
            message: Any = object.__new__(kind)
            for field, value in zip(names, values, strict=True):
                object.__setattr__(message, field, _put_together(value, places))
            return message
        case (what, dtype, shape, place) if what == _PLACED:
            return places[place].view(dtype).reshape(shape)
        case (what, dtype, shape, data) if what == _INSIDE:
            return np.frombuffer(data, dtype).reshape(shape)
    return tuple(_put_together(item, places) for item in parts[1:])


@cache
def _field_names(kind: Any) -> tuple[str, ...] | None:  # noqa: ANN401  # a class
    """Return the fields of a dataclass that has nothing but them; None for all else."""
    if not is_dataclass(kind) or "__slots__" not in kind.__dict__:
        return None
    if kind.__reduce__ is not object.__reduce__ or kind.__reduce_ex__ is not object.__reduce_ex__:
        return None
    return tuple(field.name for field in fields(kind))


@cache
def _class(name: str) -> tuple[type, tuple[str, ...]]:
    module, _, path = name.partition(":")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    return found, tuple(field.name for field in fields(found))
