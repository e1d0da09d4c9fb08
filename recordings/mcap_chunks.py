"""Chunks of an MCAP file as blocks of messages: decompressed, checked, indexed with numpy.

Finding the messages costs one short loop per record; everything else is done for the chunk at once.
"""

from __future__ import annotations

import mmap
import zlib
from dataclasses import dataclass
from typing import Final

import lz4.frame
import numpy as np
import numpy.typing as npt
import zstandard

from mapstream.recordings import mcap_records as records
from mapstream.recordings.mcap_records import DamageError

MAX_CHUNK_BYTES: Final = 1 << 30  # a file that claims more is not believed
_SCHEMA_OR_CHANNEL: Final = (records.SCHEMA, records.CHANNEL)
_MIN_RUN: Final = 8  # equal records in a row before the next ones are looked at together
_MESSAGE: Final = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
     ("log_ns", "<i8"), ("publish_ns", "<i8")]
)  # fmt: skip


@dataclass(slots=True)
class Segment:
    """A chunk, or a run of messages that lie outside of chunks."""

    offset: int  # of its first record in the file
    start_ns: int
    end_ns: int
    compression: str
    data_start: int
    data_size: int
    uncompressed_size: int
    crc: int  # 0: not known
    channels: frozenset[int] | None = None  # that have messages in it; None: not known
    index_start: int = 0  # where its MessageIndex records lie
    index_size: int = 0
    is_cut: bool = False  # the file ends inside it


@dataclass(slots=True)
class Block:
    """The messages of one segment, sorted by log time (stable: ties in file order)."""

    offset: int  # of the segment in the file
    view: memoryview
    log_ns: npt.NDArray[np.int64]
    headers: npt.NDArray[np.void]  # as _MESSAGE
    starts: npt.NDArray[np.int64]  # of the payloads in the view
    others: list[int]  # positions of schemas and channels
    damage: str = ""  # why the last part of the segment is missing

    def __len__(self) -> int:
        return len(self.log_ns)


def load(file: memoryview, segment: Segment) -> Block:
    """Read a segment.

    Raises:
        DamageError: If nothing of it can be trusted.
    """
    stop = segment.data_start + segment.data_size
    if segment.uncompressed_size > MAX_CHUNK_BYTES:
        raise DamageError(f"it claims {segment.uncompressed_size} bytes, more than any chunk has")
    if stop > len(file):
        raise DamageError("it reaches beyond the end of the file")
    view = _decompress(file[segment.data_start : stop], segment)
    if segment.compression:
        _forget(file, segment)
    if not segment.is_cut:
        if len(view) != segment.uncompressed_size:
            raise DamageError(f"{len(view)} bytes instead of {segment.uncompressed_size}")
        if segment.crc and zlib.crc32(view) != segment.crc:
            raise DamageError("its CRC does not match")
    block = _index(view, segment.offset)
    if segment.is_cut and not block.damage:
        block.damage = "the file ends inside it"
    return block


def _decompress(data: memoryview, segment: Segment) -> memoryview:
    size = segment.uncompressed_size
    try:
        if segment.compression == "":
            return data
        if segment.compression == "zstd":
            decompressor = zstandard.ZstdDecompressor()
            if segment.is_cut:
                return memoryview(decompressor.stream_reader(data).read(size))
            # zstandard allocates what the frame says, whatever the limit it is given
            found = zstandard.get_frame_parameters(data).content_size
            if found not in (size, zstandard.CONTENTSIZE_UNKNOWN):
                raise DamageError(f"it says {size} bytes and its zstd frame {found}")
            return memoryview(decompressor.decompress(data, max_output_size=size))
        if segment.compression == "lz4":
            return memoryview(lz4.frame.LZ4FrameDecompressor().decompress(data, size))
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise DamageError(f"its {segment.compression} data is damaged: {error}") from error
    raise DamageError(f"unknown compression {segment.compression!r}; known: none, zstd, lz4")


def _forget(file: memoryview, segment: Segment) -> None:
    """Give back the memory of a part of the file; else a long recording stays in it as a whole."""
    first = -(-segment.data_start // mmap.PAGESIZE)
    stop = (segment.data_start + segment.data_size) // mmap.PAGESIZE
    if isinstance(file.obj, mmap.mmap) and stop > first:
        pages = (first * mmap.PAGESIZE, (stop - first) * mmap.PAGESIZE)
        file.obj.madvise(mmap.MADV_DONTNEED, *pages)


def _index(view: memoryview, offset: int) -> Block:
    """Find the messages of uncompressed records, up to the first that is no record."""
    offsets, others, damage = _walk(view)
    starts = np.array(offsets, np.int64)
    headers = _headers(view, starts)
    log_ns = headers["log_ns"]
    if len(log_ns) > 1 and (log_ns[1:] < log_ns[:-1]).any():
        order = np.argsort(log_ns, kind="stable")
        starts, headers, log_ns = starts[order], headers[order], log_ns[order]
    log_ns = np.ascontiguousarray(log_ns)
    return Block(offset, view, log_ns, headers, starts + _MESSAGE.itemsize, others, damage)


def _headers(view: memoryview, offsets: npt.NDArray[np.int64]) -> npt.NDArray[np.void]:
    if not len(offsets):
        return np.empty(0, _MESSAGE)
    size = _MESSAGE.itemsize
    # every position seen as one item of 31 bytes: a gather then copies whole headers
    everywhere = np.ndarray((len(view) - size + 1,), f"V{size}", view, strides=(1,))
    return everywhere[offsets].view(_MESSAGE)


def _walk(view: memoryview) -> tuple[list[int], list[int], str]:
    """Return where messages are, where schemas and channels are, and what stopped the walk early."""
    messages: list[int] = []
    others: list[int] = []
    position, end = 0, len(view)
    unpack, least = records.PREFIX.unpack_from, records.MESSAGE_HEADER_SIZE
    last_length = repeats = 0
    while position + 9 <= end:
        opcode, length = unpack(view, position)
        following = position + 9 + length
        if following > end or (opcode == records.MESSAGE and length < least):
            return messages, others, f"a record of {length} bytes does not fit"
        if opcode == records.MESSAGE:
            messages.append(position)
            repeats = repeats + 1 if length == last_length else 0
            last_length = length
            if repeats >= _MIN_RUN:
                run = _run(view, following, length)
                messages.extend(run)
                following += len(run) * (9 + length)
                repeats = 0
        elif opcode in _SCHEMA_OR_CHANNEL:
            others.append(position)
        position = following
    return messages, others, "" if position == end else "it ends inside a record"


def _run(view: memoryview, start: int, length: int) -> range:
    """Return the positions of messages of one length that follow each other from `start` on."""
    stride = 9 + length
    count = (len(view) - start) // stride
    if count == 0:
        return range(0)
    opcodes = np.ndarray((count,), "u1", view, start, (stride,))
    lengths = np.ndarray((count,), "<u8", view, start + 1, (stride,))
    differs = (opcodes != records.MESSAGE) | (lengths != length)
    count = int(differs.argmax()) if differs.any() else count
    return range(start, start + count * stride, stride)
