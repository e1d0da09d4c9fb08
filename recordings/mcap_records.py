"""The records of an MCAP file, parsed with every length checked against the bytes that are there.

Source: the MCAP specification, https://mcap.dev/spec.
Times are read as signed, so that they fit int64 everywhere.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from struct import Struct
from typing import Final

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS = range(8, 12)
METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(12, 16)

PREFIX: Final = Struct("<BQ")  # opcode and length, before each record
MESSAGE_HEADER_SIZE: Final = 22  # channel, sequence, log and publish time
COMPRESSIONS: Final = ("", "zstd", "lz4")
_CHUNK_HEADER: Final = Struct("<qqQI")  # start, end, uncompressed size, CRC
_CHUNK_PATTERN: Final = re.compile(
    rb"\x06(?=[\s\S]{5}\0{3}[\s\S]{28}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4}))"
)
_MESSAGE_PATTERN: Final = re.compile(rb"\x05(?=[\s\S]{4}\0{4})")


class DamageError(Exception):
    """Bytes that do not make a record; the reader turns it into a `Loss`."""


class Fields:
    """Reads the fields of one record in order.

    Raises:
        DamageError: From each method, if the field does not fit in the record.
    """

    def __init__(self, view: memoryview, start: int, stop: int) -> None:
        self._view, self.position, self._stop = view, start, stop

    def blob(self, size: int) -> memoryview:
        start, self.position = self.position, self.position + size
        if self.position > self._stop:
            raise DamageError(f"a field of {size} bytes does not fit in its record")
        return self._view[start : self.position]

    def number(self, size: int, *, signed: bool = False) -> int:
        return int.from_bytes(self.blob(size), "little", signed=signed)

    def text(self) -> str:
        try:
            return str(self.blob(self.number(4)), "utf-8")
        except UnicodeDecodeError as error:
            raise DamageError("a text is not UTF-8") from error

    def rest(self) -> memoryview:
        return self._view[self.position : self._stop]

    def pairs(self, key_size: int, value_size: int) -> dict[int, int]:
        size = self.number(4)
        stop = self.position + size
        if stop > self._stop:
            raise DamageError(f"a table of {size} bytes does not fit in its record")
        pairs = {}
        while self.position < stop:
            key = self.number(key_size)
            pairs[key] = self.number(value_size)
        return pairs


@dataclass(frozen=True, slots=True)
class SchemaRecord:
    id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class ChannelRecord:
    id: int
    schema_id: int  # 0: no schema
    topic: str
    message_encoding: str


@dataclass(frozen=True, slots=True)
class ChunkIndexRecord:
    start_ns: int
    end_ns: int
    offset: int
    length: int  # of the whole chunk record, prefix included
    index_offsets: dict[int, int]  # channel -> its MessageIndex record
    index_length: int
    compression: str
    compressed_size: int
    uncompressed_size: int


@dataclass(frozen=True, slots=True)
class ChunkRecord:
    start_ns: int
    end_ns: int
    uncompressed_size: int
    crc: int
    compression: str
    records_start: int  # in the file
    records_size: int


@dataclass(frozen=True, slots=True)
class StatisticsRecord:
    num_messages: int
    num_chunks: int
    start_ns: int
    end_ns: int
    counts: dict[int, int]  # channel -> messages


def schema(view: memoryview, start: int, stop: int) -> SchemaRecord:
    """Parse the content of a Schema record."""
    fields = Fields(view, start, stop)
    schema_id, name, encoding = fields.number(2), fields.text(), fields.text()
    return SchemaRecord(schema_id, name, encoding, bytes(fields.blob(fields.number(4))))


def channel(view: memoryview, start: int, stop: int) -> ChannelRecord:
    """Parse the content of a Channel record."""
    fields = Fields(view, start, stop)
    channel_id, schema_id = fields.number(2), fields.number(2)
    return ChannelRecord(channel_id, schema_id, fields.text(), fields.text())


def chunk_index(view: memoryview, start: int, stop: int) -> ChunkIndexRecord:
    """Parse the content of a ChunkIndex record."""
    fields = Fields(view, start, stop)
    start_ns, end_ns = fields.number(8, signed=True), fields.number(8, signed=True)
    offset, length = fields.number(8), fields.number(8)
    offsets, index_length = fields.pairs(2, 8), fields.number(8)
    compression, compressed, uncompressed = fields.text(), fields.number(8), fields.number(8)
    return ChunkIndexRecord(
        start_ns, end_ns, offset, length, offsets, index_length, compression, compressed, uncompressed
    )  # fmt: skip


def chunk(view: memoryview, start: int, stop: int) -> ChunkRecord:
    """Parse a chunk record whose bytes may end before its data does."""
    fields = Fields(view, start, stop)
    start_ns, end_ns, size, crc = _CHUNK_HEADER.unpack(fields.blob(_CHUNK_HEADER.size))
    compression, records_size = fields.text(), fields.number(8)
    return ChunkRecord(start_ns, end_ns, size, crc, compression, fields.position, records_size)


def statistics(view: memoryview, start: int, stop: int) -> StatisticsRecord:
    """Parse the content of a Statistics record."""
    fields = Fields(view, start, stop)
    num_messages = fields.number(8)
    fields.blob(2 + 4 + 4 + 4)  # schemas, channels, attachments, metadata
    num_chunks = fields.number(4)
    start_ns, end_ns = fields.number(8, signed=True), fields.number(8, signed=True)
    return StatisticsRecord(num_messages, num_chunks, start_ns, end_ns, fields.pairs(2, 8))


def prefix(view: memoryview, position: int, stop: int) -> tuple[int, int]:
    """Return the opcode of the record at a position, and where it ends.

    Raises:
        DamageError: If no record fits there.
    """
    if position + PREFIX.size > stop:
        raise DamageError("the file ends inside a record")
    opcode, length = PREFIX.unpack_from(view, position)
    end = position + PREFIX.size + length
    if opcode == 0:
        raise DamageError("no record has the opcode 0")
    if end > stop:
        raise DamageError(f"a record of {length} bytes does not fit in the rest of the file")
    return opcode, end


def is_chunk(view: memoryview, position: int) -> bool:
    """Say whether a whole chunk record lies here, by the agreement of its two lengths."""
    try:
        _, end = prefix(view, position, len(view))
        found = chunk(view, position + PREFIX.size, end)
    except DamageError:
        return False
    return found.records_start + found.records_size == end and found.compression in COMPRESSIONS


def next_chunk(view: memoryview, start: int) -> int:
    """Find the first chunk at or after a position in damaged bytes; the length of the file if none."""
    matches = (match.start() for match in _CHUNK_PATTERN.finditer(view, start))
    return next((position for position in matches if is_chunk(view, position)), len(view))


def next_message(view: memoryview, start: int, stop: int, channels: set[int]) -> int | None:
    """Find the first message of a known channel that lies outside of chunks, in damaged bytes."""
    matches = (match.start() for match in _MESSAGE_PATTERN.finditer(view, start, stop))
    return next((position for position in matches if _is_message(view, position, channels)), None)


def _is_message(view: memoryview, position: int, channels: set[int]) -> bool:
    """A message of a known channel, with a record or the end of the file behind it."""
    try:
        _, end = prefix(view, position, len(view))
        fields = Fields(view, position + PREFIX.size, end)
        if end - fields.position < MESSAGE_HEADER_SIZE or fields.number(2) not in channels:
            return False
    except DamageError:
        return False
    return may_start(view, end)


def may_start(view: memoryview, position: int) -> bool:
    """Say whether a record, or nothing but the file's end, lies here."""
    try:
        return position == len(view) or prefix(view, position, len(view))[0] <= DATA_END
    except DamageError:
        return False


def swallowed(view: memoryview, position: int, end: int, channels: set[int]) -> int | None:
    """Find the first message that lies inside a record outside of chunks, whose length is a lie then.

    A payload may hold what looks like a message. So where the record ends at another, all that follows the
    first message must be records up to that very end.
    """
    found = next_message(view, position + 1, end, channels)
    if found is None or not may_start(view, end):
        return found
    following = found
    while following < end:
        try:
            _, following = prefix(view, following, end)
        except DamageError:
            return None
    return found
