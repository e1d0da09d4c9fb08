"""A recording as the messages of several ports, in log-time order, some at a time."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

from mapstream.operators.sources.topic_reader import Played, TopicReader
from mapstream.recordings.recording import Recording

_MAX_MESSAGES = 64  # in one batch ...
_MAX_BYTES = 4 << 20  # ... of recorded data


class Playback:
    """Reads a recording for a source; each call of `next_batch` may come from another thread."""

    def __init__(
        self, recording: Recording, readers: list[TopicReader], end_ns: int | None
    ) -> None:
        self._recording = recording
        self._readers = readers
        self._end_ns = end_ns
        self._batches: Generator[list[Played]] | None = None
        self._lags: dict[str, int] = {}  # least stamp - log time so far, by port

    def start(self, log_ns: int | None) -> None:
        """Begin at a log time, or begin there anew."""
        self.close()
        for reader in self._readers:
            reader.restart()
        self._lags = {}
        self._batches = self._play(log_ns)

    def next_batch(self) -> list[Played]:
        """Return the next messages; none at the end.

        Raises:
            RecordingError: If nothing can be read.
        """
        return next(self._batches, []) if self._batches else []

    def close(self) -> None:
        """Stop reading ahead."""
        if self._batches is not None:
            self._batches.close()
            self._batches = None

    def _play(self, log_ns: int | None) -> Generator[list[Played]]:
        by_topic: dict[str, list[TopicReader]] = {}
        for reader in self._readers:
            by_topic.setdefault(reader.topic, []).append(reader)
        batch: list[Played] = []
        num_bytes = 0
        for raw in self._recording.messages(list(by_topic), log_ns, self._end_ns):
            for reader in self._readers:
                self._gather(batch, reader, reader.flush(raw.log_ns))
            for reader in by_topic[raw.topic]:
                self._gather(batch, reader, reader.read(raw))
            num_bytes += len(raw.data)
            if batch and (len(batch) >= _MAX_MESSAGES or num_bytes >= _MAX_BYTES):
                yield batch
                batch, num_bytes = [], 0
        for reader in self._readers:
            self._gather(batch, reader, reader.flush())
        if batch:
            yield batch

    def _gather(self, batch: list[Played], reader: TopicReader, found: list[Played]) -> None:
        """Take messages; where a clock jumped, what the others hold still belongs before it."""
        if any(played.starts_epoch for played in found):
            for other in self._readers:
                if other is not reader:
                    batch += [replace(played, lags=self._lags) for played in other.flush()]
                    other.watch.restart()
        for played in found:
            if played.starts_epoch:
                self._lags = {}  # those of the messages before stay as they were
            batch.append(replace(played, lags=self._lags))
        if found:
            self._lags[reader.reading.port] = reader.watch.least_offset_ns
