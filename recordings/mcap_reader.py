"""Read MCAP files: memory-mapped, chunks decompressed ahead, messages in log-time order.

Chunks may overlap in time: a message is yielded once no chunk that is still closed can hold an older
one, so only chunks that overlap are open together. Equal times keep the order of the file.
A chunk that cannot be read is a `Loss`; reading goes on behind it.
"""

from __future__ import annotations

import mmap
import zlib
from collections import deque
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise, repeat
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from mapstream.recordings import mcap_records as records
from mapstream.recordings.mcap_chunks import Block, Segment, load
from mapstream.recordings.mcap_layout import (
    Attachment,
    InsufficientError,
    Layout,
    Span,
    from_summary,
)
from mapstream.recordings.mcap_records import DamageError, Fields
from mapstream.recordings.mcap_survey import survey
from mapstream.recordings.recording import Loss, RawMessage, Topic, check_topics
from mapstream.streams.errors import RecordingError

_AHEAD: Final = 3  # chunks that are decompressed before they are needed
_WORKERS: Final = 2


class McapRecording:
    """A recording in one MCAP file."""

    def __init__(self, path: str | Path) -> None:
        """Open a file, and survey it where it has no usable summary.

        Raises:
            RecordingError: If it is empty, no MCAP file, or nothing in it can be read.
        """
        self.path = Path(path)
        try:
            with self.path.open("rb") as file:
                self._view = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        except OSError as error:
            raise RecordingError(f"{path}: cannot be opened: {error.strerror}") from error
        except ValueError as error:
            raise RecordingError(
                f"{path}: the file is empty (0 bytes); was it copied whole?"
            ) from error
        self._layout = self._find_layout()
        self.losses: list[Loss] = list(self._layout.losses)
        self.topics = _topics(self._layout)
        spans = self._layout.spans.values()
        self.start_ns = min((span.first_ns for span in spans), default=0)
        self.end_ns = max((span.last_ns for span in spans), default=0)

    def _find_layout(self) -> Layout:
        try:
            return from_summary(self._view)
        except DamageError as damage:
            layout = survey(self._view)
            if not isinstance(damage, InsufficientError):
                loss = Loss(offset=len(self._view), reason=f"summary: {damage}", num_messages=0)
                layout.losses.append(loss)
            if layout.losses and not layout.segments:
                first = layout.losses[0]
                raise RecordingError(
                    f"{self.path}: no message can be read: at byte {first.offset} {first.reason}; "
                    "is it an MCAP file, and was it copied whole?"
                ) from damage
            return layout

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[RawMessage]:
        """Yield messages in log-time order, from `start_ns` on and before `end_ns`.

        Raises:
            RecordingError: If a topic is not in the recording, or every chunk asked for is damaged.
        """
        if not self._view:
            raise RecordingError(f"{self.path}: was closed")
        check_topics(self.path, topics, self.topics)
        selection = _Selection(self._view, self._layout, topics)
        selection.between(start_ns, end_ns)
        return self._merged(selection)

    def _merged(self, selection: _Selection) -> Iterator[RawMessage]:
        segments = selection.segments
        horizons = [later.start_ns for _, later in pairwise(segments)]
        channels = self._layout.channels
        pending: list[Block] = []
        num_lost = 0
        for i, block in enumerate(self._load_ahead(selection)):
            num_lost += block is None
            if block is not None and len(block):
                pending.append(block)
            if not pending:
                continue
            ready, pending = _split(pending, horizons[i] if i < len(horizons) else None)
            for channel, log_ns, publish_ns, sequence, view, start, stop in _rows(ready):
                data = view[start:stop]
                yield RawMessage(channels[channel], log_ns, publish_ns, sequence, data)
        if segments and num_lost == len(segments):
            first = min(segments, key=lambda segment: segment.offset)
            raise RecordingError(
                f"{self.path}: nothing can be read: all {num_lost} chunks asked for are damaged, the "
                f"first at byte {first.offset}; `mapstream doctor` lists what is left"
            )

    def _load_ahead(self, selection: _Selection) -> Iterator[Block | None]:
        """Yield the block of each segment, or None for one that is lost."""
        pool = ThreadPoolExecutor(_WORKERS, "mcap")
        waiting: deque[tuple[Segment, Future[Block]]] = deque()
        try:
            for segment in selection.segments:
                waiting.append((segment, pool.submit(selection.load, segment)))
                if len(waiting) > _AHEAD:
                    yield self._result(*waiting.popleft())
            while waiting:
                yield self._result(*waiting.popleft())
        finally:
            pool.shutdown(wait=False, cancel_futures=True)

    def _result(self, segment: Segment, future: Future[Block]) -> Block | None:
        try:
            block = future.result()
        except DamageError as damage:
            self._lose(self._layout.chunk_loss(self._view, segment, str(damage)))
            return None
        if block.damage:
            self._lose(Loss(offset=segment.offset, reason=f"chunk: {block.damage}"))
        return block

    def _lose(self, loss: Loss) -> None:
        """Count a loss once, however often the recording is read."""
        if all(loss.offset != known.offset for known in self.losses):
            self.losses.append(loss)

    @property
    def attachments(self) -> list[Attachment]:
        return list(self._layout.attachments)

    def attachment(self, name: str) -> bytes:
        """Return the content of an attached file.

        Raises:
            RecordingError: If there is none of that name, or its CRC does not match.
        """
        found = next((a for a in self._layout.attachments if a.name == name), None)
        if found is None:
            names = ", ".join(a.name for a in self._layout.attachments) or "none"
            raise RecordingError(f"{self.path}: no attachment {name!r}; there are: {names}")
        try:
            _, end = records.prefix(self._view, found.offset, len(self._view))
            fields = Fields(self._view, found.offset + 9, end)
            fields.blob(8 + 8)
            fields.text(), fields.text()
            content = fields.blob(fields.number(8))
            checked = self._view[found.offset + 9 : fields.position]
            crc = fields.number(4)
        except DamageError as damage:
            raise RecordingError(f"{self.path}: attachment {name!r}: {damage}") from damage
        if crc and zlib.crc32(checked) != crc:
            raise RecordingError(
                f"{self.path}: attachment {name!r} at byte {found.offset}: its CRC does not match; "
                "the file was changed after it was written"
            )
        return bytes(content)

    def close(self) -> None:
        """Let go of the file. It stays mapped until the last message that views it is gone."""
        self._view = memoryview(b"")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


class _Selection:
    """Which segments and messages a reader asked for."""

    def __init__(self, view: memoryview, layout: Layout, topics: Collection[str] | None) -> None:
        self._view = view
        self._chosen = {
            i for i, c in layout.channels.items() if topics is None or c.topic in topics
        }
        self._is_chosen = np.zeros(1 << 16, np.bool_)  # by channel
        self._is_chosen[list(self._chosen)] = True
        self.segments = layout.segments

    def between(self, start_ns: int | None, end_ns: int | None) -> None:
        """Choose the segments, in the order of their first messages."""
        self._start_ns = -(2**63) if start_ns is None else start_ns
        self._end_ns = 2**63 - 1 if end_ns is None else end_ns
        self.segments = sorted(
            filter(self._may_hold, self.segments),
            key=lambda segment: (segment.start_ns, segment.offset),
        )

    def _may_hold(self, segment: Segment) -> bool:
        if segment.channels is not None and self._chosen.isdisjoint(segment.channels):
            return False
        return segment.start_ns < self._end_ns and segment.end_ns >= self._start_ns

    def load(self, segment: Segment) -> Block:
        """Read a segment and keep the messages asked for."""
        block = load(self._view, segment)
        keep = self._is_chosen[block.headers["channel"]]
        if len(block) and block.log_ns[0] < self._start_ns:
            keep &= block.log_ns >= self._start_ns
        if len(block) and block.log_ns[-1] >= self._end_ns:
            keep &= block.log_ns < self._end_ns
        return block if keep.all() else _part(block, keep)


def _part(block: Block, keep: npt.NDArray[np.bool_] | slice) -> Block:
    log_ns, headers, starts = block.log_ns[keep], block.headers[keep], block.starts[keep]
    return replace(block, log_ns=log_ns, headers=headers, starts=starts)


def _split(pending: list[Block], horizon_ns: int | None) -> tuple[list[Block], list[Block]]:
    """Return the parts before the horizon, and what has to wait for chunks that are still closed."""
    ready, waiting = [], []
    for block in pending:
        count = len(block)
        if horizon_ns is not None:
            count = int(np.searchsorted(block.log_ns, horizon_ns))
        if count:
            ready.append(_part(block, slice(count)))
        if count < len(block):
            waiting.append(_part(block, slice(count, None)))
    return ready, waiting


_Row = tuple[int, int, int, int, memoryview, int, int]


def _rows(blocks: list[Block]) -> Iterator[_Row]:
    """Merge blocks: channel, log time, publish time, sequence, and where the payload is."""
    if not blocks:
        return iter(())
    blocks.sort(key=lambda block: block.offset)
    log_ns = np.concatenate([block.log_ns for block in blocks])
    headers = np.concatenate([block.headers for block in blocks])
    starts = np.concatenate([block.starts for block in blocks])
    views: Iterable[memoryview] = repeat(blocks[0].view, len(log_ns))
    if len(blocks) > 1:
        order = np.argsort(log_ns, kind="stable")
        log_ns, headers, starts = log_ns[order], headers[order], starts[order]
        owners = np.repeat(np.arange(len(blocks)), [len(block) for block in blocks])[order]
        views = [blocks[owner].view for owner in owners.tolist()]
    stops = starts + (headers["length"].astype(np.int64) - records.MESSAGE_HEADER_SIZE)
    return zip(
        headers["channel"].tolist(),
        log_ns.tolist(),
        headers["publish_ns"].tolist(),
        headers["sequence"].tolist(),
        views,
        starts.tolist(),
        stops.tolist(),
        strict=True,
    )


def _topics(layout: Layout) -> dict[str, Topic]:
    """Return topics by name; several channels of one topic count together."""
    spans: dict[str, Span] = {}
    for channel_id, span in layout.spans.items():
        name = layout.channels[channel_id].topic
        spans[name] = spans[name].joined(span) if name in spans else span
    topics: dict[str, Topic] = {}
    for channel in layout.channels.values():
        span = spans.get(channel.topic, Span(0, 0, 0))
        first = topics.get(channel.topic)
        topics[channel.topic] = first or Topic(
            channel=channel, count=span.count, first_ns=span.first_ns, last_ns=span.last_ns
        )
    return topics
