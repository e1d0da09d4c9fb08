"""A message as bytes for another process of the same run: its large arrays in shared memory, the rest pickled.

Pickle is safe here, and only here: both ends are this program, and no one else can write to the pipe.
"""

from __future__ import annotations

import io
import pickle
import struct
from typing import Any

import numpy as np

from mapstream.graph.ring import Region, RingReader, RingWriter, Span

_SMALL = 2048  # bytes; copying these with the rest costs less than a place of their own
_HEAD = struct.Struct("<hH")  # index of the region or -1, number of spans
_SPAN = struct.Struct("<QQ?")


class _Pickler(pickle.Pickler):
    """Gives arrays with gaps between their elements a plain copy, which then travels as a buffer."""

    def reducer_override(self, value: object) -> Any:  # noqa: ANN401  # as pickle says
        if type(value) is not np.ndarray or value.dtype.hasobject:
            return NotImplemented
        if value.flags.c_contiguous or value.flags.f_contiguous:
            return NotImplemented
        plain = np.ascontiguousarray(value)
        plain.flags.writeable = value.flags.writeable
        return plain.__reduce_ex__(5)


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
    return b"".join([_HEAD.pack(region.index, len(spans)), *spans, file.getbuffer()])


def unpack(data: memoryview, ring: RingReader) -> Any:  # noqa: ANN401  # any message
    """Return the message; its large arrays are views on the shared memory, read-only where they were."""
    index, num_spans = _HEAD.unpack_from(data)
    if index < 0:
        return pickle.loads(data[_HEAD.size :])  # noqa: S301  # written by our own process
    end = _HEAD.size + num_spans * _SPAN.size
    spans = tuple(Span(*fields) for fields in _SPAN.iter_unpack(data[_HEAD.size : end]))
    return pickle.loads(data[end:], buffers=ring.read(Region(index, spans)))  # noqa: S301  # the same
