"""Where things lie in an MCAP file, by the summary at its end."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from mapstream.recordings import mcap_records as records
from mapstream.recordings.mcap_chunks import Segment
from mapstream.recordings.mcap_records import DamageError, Fields
from mapstream.recordings.recording import MCAP_MAGIC, Channel, Loss

_FOOTER_SIZE = 9 + 8 + 8 + 4


class InsufficientError(DamageError):
    """The summary is sound, but the file cannot be read by it alone."""


@dataclass(slots=True)
class Span:
    """How many messages of one channel there are, and when."""

    count: int
    first_ns: int
    last_ns: int

    def joined(self, other: Span) -> Span:
        first_ns, last_ns = min(self.first_ns, other.first_ns), max(self.last_ns, other.last_ns)
        return Span(self.count + other.count, first_ns, last_ns)


@dataclass(slots=True)
class Attachment:
    """A file inside the file; read with `McapRecording.attachment`."""

    name: str
    media_type: str
    log_ns: int
    offset: int


@dataclass(slots=True)
class Layout:
    """What is in a file and where; `segments` is in file order."""

    segments: list[Segment] = field(default_factory=list)
    channels: dict[int, Channel] = field(default_factory=dict)
    spans: dict[int, Span] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    losses: list[Loss] = field(default_factory=list)
    _schemas: dict[int, records.SchemaRecord] = field(default_factory=dict)
    _channel_records: dict[int, records.ChannelRecord] = field(default_factory=dict)

    def add(self, view: memoryview, position: int, end: int) -> None:
        """Take note of a schema, channel or attachment record."""
        opcode, start = view[position], position + 9
        if opcode == records.SCHEMA:
            schema = records.schema(view, start, end)
            self._schemas.setdefault(schema.id, schema)
        elif opcode == records.CHANNEL:
            channel = records.channel(view, start, end)
            self._channel_records.setdefault(channel.id, channel)
        elif opcode == records.ATTACHMENT:
            fields = Fields(view, start, end)
            log_ns, _ = fields.number(8, signed=True), fields.number(8)
            self.attachments.append(Attachment(fields.text(), fields.text(), log_ns, position))

    def describe_channels(self) -> None:
        """Join channels with their schemas; a channel may have none (id 0), or have lost it."""
        for channel_id, record in self._channel_records.items():
            schema = self._schemas.get(record.schema_id)
            if schema is None and record.schema_id != 0:
                reason = f"schema {record.schema_id} of topic {record.topic} is nowhere in the file"
                self.losses.append(Loss(offset=0, reason=reason, topic=record.topic))
            self.channels[channel_id] = Channel(
                topic=record.topic,
                message_encoding=record.message_encoding,
                schema_name=schema.name if schema else "",
                schema_encoding=schema.encoding if schema else "",
                schema_data=schema.data if schema else b"",
            )

    def chunk_loss(self, view: memoryview, segment: Segment, reason: str) -> Loss:
        """Say what was in a chunk that cannot be read, as far as its message indexes tell."""
        counts = {channel: len(t) for channel, t in indexed_times(view, segment).items() if len(t)}
        names = {self.channels[c].topic for c in counts if c in self.channels}
        return Loss(
            offset=segment.offset,
            reason=f"chunk: {reason}",
            topic=names.pop() if len(names) == 1 else None,
            num_messages=sum(counts.values()) if counts else None,
            num_bytes=segment.data_size,
        )

    @property
    def known_ids(self) -> set[int]:
        return set(self._channel_records)


def from_summary(view: memoryview) -> Layout:
    """Use the index at the end.

    Raises:
        DamageError: If it is damaged or not there.
        InsufficientError: If it says less than is needed to read the file by it.
    """
    start, footer = _summary_bounds(view)
    layout = Layout()
    chunks: list[records.ChunkIndexRecord] = []
    statistics: records.StatisticsRecord | None = None
    for position, end in _records(view, start, footer):
        opcode = view[position]
        if opcode == records.CHUNK_INDEX:
            chunks.append(records.chunk_index(view, position + 9, end))
        elif opcode == records.STATISTICS:
            statistics = records.statistics(view, position + 9, end)
        elif opcode == records.ATTACHMENT_INDEX:
            offset = Fields(view, position + 9, end).number(8)
            layout.add(view, offset, records.prefix(view, offset, start)[1])
        else:
            layout.add(view, position, end)
    if statistics is None or statistics.num_chunks != len(chunks):
        raise InsufficientError("it does not list all chunks")
    if not chunks and statistics.num_messages:
        raise InsufficientError("the messages are not in chunks")
    if not layout.known_ids.issuperset(statistics.counts):
        raise InsufficientError("it does not list all channels")
    layout.describe_channels()
    if layout.losses:
        raise InsufficientError("it does not list all schemas")
    layout.segments = [_indexed_segment(view, chunk) for chunk in chunks]
    layout.segments.sort(key=lambda segment: segment.offset)
    for channel_id, count in statistics.counts.items():
        first_ns = _first(view, layout.segments, channel_id)
        last_ns = _first(view, layout.segments, channel_id, backward=True)
        layout.spans[channel_id] = Span(
            count,
            statistics.start_ns if first_ns is None else first_ns,
            statistics.end_ns if last_ns is None else last_ns,
        )
    return layout


def _summary_bounds(view: memoryview) -> tuple[int, int]:
    footer = len(view) - len(MCAP_MAGIC) - _FOOTER_SIZE
    if footer < len(MCAP_MAGIC) or view[-len(MCAP_MAGIC) :] != MCAP_MAGIC:
        raise DamageError("no footer, the file was not finished")
    if records.prefix(view, footer, len(view))[0] != records.FOOTER:
        raise DamageError("no footer where it should be")
    fields = Fields(view, footer + 9, footer + _FOOTER_SIZE)
    start, _, crc = fields.number(8), fields.number(8), fields.number(4)
    if not len(MCAP_MAGIC) <= start < footer:
        raise InsufficientError("the file has none")
    if crc and zlib.crc32(view[start : footer + 25]) != crc:
        raise DamageError("its CRC does not match")
    return start, footer


def _records(view: memoryview, start: int, stop: int) -> Iterator[tuple[int, int]]:
    while start < stop:
        _, end = records.prefix(view, start, stop)
        yield start, end
        start = end


def _indexed_segment(view: memoryview, chunk: records.ChunkIndexRecord) -> Segment:
    """Locate a chunk by its index alone, so that a damaged chunk header costs nothing."""
    end = chunk.offset + chunk.length
    crc_at = chunk.offset + 9 + 8 + 8 + 8
    if end > len(view) or crc_at + 4 > end or chunk.compressed_size > chunk.length:
        raise DamageError("a chunk lies outside the file")
    return Segment(
        offset=chunk.offset,
        start_ns=chunk.start_ns,
        end_ns=chunk.end_ns,
        compression=chunk.compression,
        data_start=end - chunk.compressed_size,
        data_size=chunk.compressed_size,
        uncompressed_size=chunk.uncompressed_size,
        crc=int.from_bytes(view[crc_at : crc_at + 4], "little"),
        channels=frozenset(chunk.index_offsets) or None,
        index_start=end,
        index_size=chunk.index_length if end + chunk.index_length <= len(view) else 0,
    )


def indexed_times(view: memoryview, segment: Segment) -> dict[int, npt.NDArray[np.int64]]:
    """Return the log times of each channel by the MessageIndex records of a chunk."""
    times: dict[int, npt.NDArray[np.int64]] = {}
    stop = segment.index_start + segment.index_size
    try:
        for position, end in _records(view, segment.index_start, stop):
            if view[position] != records.MESSAGE_INDEX:
                continue
            fields = Fields(view, position + 9, end)
            channel_id, size = fields.number(2), fields.number(4)
            times[channel_id] = np.frombuffer(fields.blob(size - size % 16), "<i8")[::2]
    except DamageError:
        return {}  # an index is a help; what it tells of is elsewhere
    return times


def _first(
    view: memoryview, segments: list[Segment], channel_id: int, *, backward: bool = False
) -> int | None:
    """Return a channel's first log time (or its last), from as few message indexes as need be."""
    sign = -1 if backward else 1
    edges = [(-s.end_ns if backward else s.start_ns, s) for s in segments]
    best: int | None = None
    for edge, segment in sorted(edges, key=lambda pair: pair[0]):
        if best is not None and edge >= best:
            break
        if segment.channels is not None and channel_id not in segment.channels:
            continue
        times = indexed_times(view, segment).get(channel_id)
        if times is not None and times.size:
            nearest = int((sign * times).min())
            best = nearest if best is None else min(best, nearest)
    return None if best is None else sign * best
