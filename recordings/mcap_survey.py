"""Where things lie in an MCAP file that has no usable summary: truncated, damaged, or written without.

Every chunk is decompressed once, so that topics, counts, times and damage are known exactly before the
first message is read. Damage ends at the next chunk or message that agrees with itself.
"""

from __future__ import annotations

import zlib
from dataclasses import replace

import numpy as np

from mapstream.recordings import mcap_records as records
from mapstream.recordings.mcap_chunks import Block, Segment, load
from mapstream.recordings.mcap_layout import Layout, Span
from mapstream.recordings.mcap_records import DamageError
from mapstream.recordings.recording import MCAP_MAGIC, Loss

_RUN_BYTES = 4 << 20  # of messages outside of chunks that make one segment


def survey(view: memoryview) -> Layout:
    """Walk through the whole file, past damage."""
    return _Survey(view).walk()


class _Survey:
    def __init__(self, view: memoryview) -> None:
        self._view = view
        self._layout = Layout()
        self._run: tuple[int, int] | None = None  # messages outside of chunks
        self._has_runs = False
        self._is_past_data = False
        self._damaged: list[Segment] = []
        self._next_chunk = -1  # where the last search ended
        self._longest = 0  # of the records outside of chunks so far

    def walk(self) -> Layout:
        view, layout = self._view, self._layout
        position = len(MCAP_MAGIC)
        if view[:position] != MCAP_MAGIC:
            position = self._skip(0, "the file does not start as MCAP files do")
        while position < len(view) and view[position:] != MCAP_MAGIC:
            try:
                position = self._take(position)
            except DamageError as damage:
                position = self._skip(position, str(damage))
        self._end_run()
        self._describe_from_damaged()
        layout.describe_channels()
        for channel_id in set(layout.spans) - set(layout.channels):
            count = layout.spans.pop(channel_id).count
            reason = f"no record describes channel {channel_id}"
            layout.losses.append(Loss(offset=0, reason=reason, num_messages=count))
        return layout

    def _take(self, position: int) -> int:
        """Take note of one record; return where the next one is."""
        view = self._view
        opcode, end = records.prefix(view, position, len(view))
        if opcode not in (records.CHUNK, records.DATA_END):
            self._check_length(position, end)
        if opcode == records.MESSAGE:
            self._extend_run(position, end)
        elif opcode == records.CHUNK or (
            opcode > records.DATA_END and records.is_chunk(view, position)
        ):
            if not records.is_chunk(view, position):
                raise DamageError("a chunk whose lengths do not agree")
            self._end_run()
            self._add_chunk(position, end)
        elif records.DATA_END < opcode < 0x80:  # from 0x80 on, records are private
            raise DamageError(f"no record has the opcode {opcode}")
        elif opcode == records.DATA_END and end == position + 9 + 4:
            self._end_data(position)
        else:
            self._layout.add(view, position, end)
        return end

    def _check_length(self, position: int, end: int) -> None:
        """Refuse a record that takes messages with it; only where its length is odd, for a search costs time.

        Raises:
            DamageError: If it does.
        """
        view, known = self._view, self._layout.known_ids
        is_odd = end - position > self._longest or not records.may_start(view, end)
        if is_odd and records.swallowed(view, position, end, known) is not None:
            raise DamageError("a record whose length takes in other messages")
        self._longest = max(self._longest, end - position)

    def _skip(self, position: int, reason: str) -> int:
        """Find the next readable record behind damage, and count what lies between."""
        self._end_run()
        view = self._view
        if self._next_chunk <= position:
            self._next_chunk = records.next_chunk(view, position + 1)
        known = self._layout.known_ids
        found = records.next_message(view, position + 1, self._next_chunk, known)
        following = self._next_chunk if found is None else found
        if following == len(view) and self._add_cut_chunk(position):
            return following
        if not self._is_past_data:
            size = following - position
            self._layout.losses.append(Loss(offset=position, reason=reason, num_bytes=size))
        return following

    def _add_cut_chunk(self, position: int) -> bool:
        """Keep the whole messages of a chunk that the file ends in, if there is one here."""
        view = self._view
        if view[position] != records.CHUNK:
            return False
        try:
            chunk = records.chunk(view, position + 9, len(view))
        except DamageError:
            return False
        claimed = records.PREFIX.unpack_from(view, position)[1]
        if position + 9 + claimed != chunk.records_start + chunk.records_size:
            return False
        self._add_chunk(position, len(view))
        return True

    def _add_chunk(self, position: int, end: int) -> None:
        view = self._view
        chunk = records.chunk(view, position + 9, end)
        size = min(chunk.records_size, end - chunk.records_start)
        segment = Segment(
            offset=position,
            start_ns=chunk.start_ns,
            end_ns=chunk.end_ns,
            compression=chunk.compression,
            data_start=chunk.records_start,
            data_size=size,
            uncompressed_size=chunk.uncompressed_size,
            crc=chunk.crc,
            index_start=end,
            index_size=self._index_size(end),
            is_cut=size < chunk.records_size,
        )
        self._add_segment(segment)

    def _index_size(self, start: int) -> int:
        view, end = self._view, start
        while end < len(view) and view[end] == records.MESSAGE_INDEX:
            try:
                _, end = records.prefix(view, end, len(view))
            except DamageError:
                break
        return end - start

    def _add_segment(self, segment: Segment) -> None:
        layout = self._layout
        try:
            block = load(self._view, segment)
        except DamageError as damage:
            layout.losses.append(layout.chunk_loss(self._view, segment, str(damage)))
            self._damaged.append(segment)
            return
        self._describe(block)
        if block.damage:
            layout.losses.append(Loss(offset=segment.offset, reason=f"chunk: {block.damage}"))
        if not len(block):
            return
        segment.start_ns, segment.end_ns = int(block.log_ns[0]), int(block.log_ns[-1])
        segment.channels = frozenset(self._count(block))
        layout.segments.append(segment)

    def _describe(self, block: Block) -> None:
        """Take note of the schemas and channels in a chunk, as far as each is whole."""
        for position in block.others:
            _, end = records.prefix(block.view, position, len(block.view))
            try:
                self._layout.add(block.view, position, end)
            except DamageError as damage:
                reason = f"a description of topics: {damage}"
                self._layout.losses.append(Loss(offset=block.offset, reason=reason))

    def _describe_from_damaged(self) -> None:
        """Take descriptions that are nowhere else from damaged chunks: most files have them once."""
        if self._layout.known_ids.issuperset(self._layout.spans):
            return
        for segment in self._damaged:
            try:
                self._describe(load(self._view, replace(segment, is_cut=True)))
            except DamageError:
                continue  # it is a loss already

    def _count(self, block: Block) -> list[int]:
        ids = block.headers["channel"]
        found = [int(channel_id) for channel_id in np.unique(ids)]
        for channel_id in found:
            times = block.log_ns[ids == channel_id]
            span = Span(len(times), int(times[0]), int(times[-1]))
            before = self._layout.spans.get(channel_id)
            self._layout.spans[channel_id] = before.joined(span) if before else span
        return found

    def _extend_run(self, position: int, end: int) -> None:
        self._has_runs = True
        if self._run is None or self._run[1] - self._run[0] > _RUN_BYTES:
            self._end_run()
            self._run = (position, end)
        self._run = (self._run[0], end)

    def _end_run(self) -> None:
        if self._run is None:
            return
        start, end = self._run
        self._run = None
        self._add_segment(
            Segment(
                offset=start,
                start_ns=0,
                end_ns=0,
                compression="",
                data_start=start,
                data_size=end - start,
                uncompressed_size=end - start,
                crc=0,
            )
        )

    def _end_data(self, position: int) -> None:
        """Check the CRC of the whole file: the only one that covers messages outside of chunks."""
        self._end_run()
        self._is_past_data = True
        crc = int.from_bytes(self._view[position + 9 : position + 13], "little")
        if self._has_runs and crc and zlib.crc32(self._view[:position]) != crc:
            reason = "the CRC of the data differs: some of the messages are not what was recorded"
            self._layout.losses.append(Loss(offset=0, reason=reason))
