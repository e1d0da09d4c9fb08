"""Memory that two processes share, so that the arrays of a message are written once and read in place.

It is an anonymous file: it has no name, so nothing has to be unlinked, and nothing stays behind in
/dev/shm however the processes end. One side writes, the other reads. A message's arrays lie in one
region; a byte per region says whether it is taken. The writer sets it, and the reader clears it when the
last array that looks into the region is gone, so no message has to say so. Beside these the reader notes
the stamp of what it took last from each port: the writer can still read that when the reader has crashed.
"""

from __future__ import annotations

import mmap
import os
import sys
import tempfile
import weakref
from bisect import insort
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

_NUM_REGIONS = 128  # messages in the memory at a time
_NUM_NOTES = 64  # ports
_NOTHING = -(2**63)
_ALIGNMENT = 64  # bytes: of a cache line, and more than any dtype asks for


def make_memory(size: int) -> int:
    """Return the descriptor of new anonymous memory; whoever closes the last one frees it."""
    if sys.platform == "linux":
        descriptor = os.memfd_create("mapstream")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    _notes(mmap.mmap(descriptor, 0))[:] = _NOTHING
    return descriptor


def _notes(memory: mmap.mmap) -> npt.NDArray[np.int64]:
    return np.frombuffer(memory, np.int64, _NUM_NOTES, offset=_NUM_REGIONS)


class Span(NamedTuple):
    """Where one array lies."""

    start: int
    size: int
    is_read_only: bool


class Region(NamedTuple):
    """Where the arrays of one message lie."""

    number: int
    spans: tuple[Span, ...]


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT


_FIRST = _aligned(_NUM_REGIONS + 8 * _NUM_NOTES)  # where regions may begin


class RingWriter:
    """The side that places messages; always as low as possible, which keeps the pages warm."""

    def __init__(self, descriptor: int) -> None:
        memory = mmap.mmap(descriptor, 0)
        self._memory: npt.NDArray[np.uint8] = np.frombuffer(memory, np.uint8)
        self._notes = _notes(memory)
        self._taken: list[tuple[int, int, int]] = []  # start, end, index; by start

    def write(self, arrays: Sequence[npt.NDArray[Any]]) -> Region | None:
        """Copy arrays of any layout into a free region, in C order; None if none is large enough now."""
        memory = self._memory
        self._taken = [region for region in self._taken if memory[region[2]]]
        size = sum(_aligned(array.nbytes) for array in arrays)
        start = self._gap(size)
        if start is None or len(self._taken) == _NUM_REGIONS:
            return None
        used = {index for _, _, index in self._taken}
        index = next(i for i in range(_NUM_REGIONS) if i not in used)
        insort(self._taken, (start, start + size, index))
        spans = []
        for array in arrays:
            num_bytes = array.nbytes
            place = memory[start : start + num_bytes].view(array.dtype).reshape(array.shape)
            place[...] = array
            spans.append(Span(start, num_bytes, not array.flags.writeable))
            start += _aligned(num_bytes)
        memory[index] = 1
        return Region(index, tuple(spans))

    def noted(self, port: int) -> int | None:
        """Return the stamp that the reader noted last for a port."""
        stamp_ns = int(self._notes[port]) if port < _NUM_NOTES else _NOTHING
        return None if stamp_ns == _NOTHING else stamp_ns

    def _gap(self, size: int) -> int | None:
        """Return the lowest place where `size` bytes are free."""
        start = _FIRST
        for taken_start, taken_end, _ in self._taken:
            if taken_start - start >= size:
                return start
            start = taken_end
        return start if self._memory.nbytes - start >= size else None


class RingReader:
    """The side that looks at messages where they lie."""

    def __init__(self, descriptor: int) -> None:
        memory = mmap.mmap(descriptor, 0)
        self._memory: npt.NDArray[np.uint8] = np.frombuffer(memory, np.uint8)
        self._notes = _notes(memory)
        self._held: dict[int, weakref.ref[npt.NDArray[np.uint8]]] = {}
        self._num_bytes_held = 0

    def read(self, region: Region) -> list[npt.NDArray[np.uint8]]:
        """Return the bytes of a region's arrays; it is free again when no array looks into them any more.

        Where much is held already, the rest is copied, so that the writer does not run out of room.
        """
        first, last = region.spans[0], region.spans[-1]
        start, size = first.start, last.start + last.size - first.start
        whole = self._memory[start : start + size]
        if self._num_bytes_held + size > self._memory.nbytes // 2:
            whole = whole.copy()
            self._memory[region.number] = 0
        else:
            self._num_bytes_held += size
            forget = partial(self._free, region.number, size)
            self._held[region.number] = weakref.ref(whole, forget)
        view = memoryview(whole)  # type: ignore[arg-type]  # typeshed: a buffer only from Python 3.12
        parts = []
        for span in region.spans:  # a slice of `whole` would not keep it alive, a memoryview does
            part = view[span.start - start : span.start - start + span.size]
            parts.append(np.frombuffer(part.toreadonly() if span.is_read_only else part, np.uint8))
        return parts

    def note(self, port: int, stamp_ns: int) -> None:
        """Leave word for the writer of what was taken last from a port."""
        if port < _NUM_NOTES:
            self._notes[port] = stamp_ns

    def _free(self, index: int, size: int, _: object) -> None:
        """Give a region back; called by whichever thread drops the last array."""
        del self._held[index]
        self._num_bytes_held -= size
        self._memory[index] = 0
