"""ROS 1 bags and rosbag2 folders or databases as recordings, through rosbags; no ROS is needed."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from struct import error as StructError  # noqa: N812  # an error in all but name
from types import TracebackType
from typing import Any, Final, Self

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader as BagReader
from rosbags.rosbag1 import ReaderError as BagError
from rosbags.rosbag2 import Reader as FolderReader
from rosbags.rosbag2 import ReaderError as FolderError

from mapstream.recordings.recording import Channel, Loss, RawMessage, Topic, check_topics
from mapstream.streams.errors import RecordingError

_BATCH: Final = 64  # messages that are read ahead
_DAMAGE: Final = (
    BagError, FolderError, sqlite3.Error, OSError, ValueError, KeyError, AssertionError,
    RuntimeError, EOFError, StructError,
)  # fmt: skip  # rosbags lets through what its libraries raise
_Reader = BagReader | FolderReader


class RosbagRecording:
    """A recording in a `.bag` file, or in a rosbag2 folder or one of its `.db3` files."""

    def __init__(self, path: str | Path) -> None:
        """Read the index.

        Raises:
            RecordingError: If the file is damaged before its first message, or lacks its index.
        """
        self.path = Path(path)
        self.losses: list[Loss] = []
        try:
            with self._reader() as reader:
                self._channels = {c.id: _channel(c) for c in reader.connections}
                self.topics = _topics(reader, self._channels)
        except _DAMAGE as error:
            raise RecordingError(
                f"{path}: {error}; a bag that was not closed needs `rosbag reindex`, a database its "
                "metadata.yaml beside it"
            ) from error
        counted = [topic for topic in self.topics.values() if topic.count]
        self.start_ns = min((topic.first_ns for topic in counted), default=0)
        self.end_ns = max((topic.last_ns for topic in counted), default=0)

    def _reader(self) -> _Reader:
        is_ros2 = self.path.is_dir() or self.path.suffix == ".db3"
        return FolderReader(self.path) if is_ros2 else BagReader(self.path)

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[RawMessage]:
        """Yield messages in log-time order, from `start_ns` on and before `end_ns`.

        Raises:
            RecordingError: If a topic is not in the recording.
        """
        check_topics(self.path, topics, self.topics)
        return self._read_ahead(topics, start_ns, end_ns)

    def _read_ahead(
        self, topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Iterator[RawMessage]:
        """Read in a thread of its own, since a database may be used from one thread only."""
        messages = self._in_order(topics, start_ns, end_ns)
        with ThreadPoolExecutor(1, "rosbag") as pool:
            try:
                batch = pool.submit(lambda: list(islice(messages, _BATCH))).result()
                while batch:
                    ahead = pool.submit(lambda: list(islice(messages, _BATCH)))
                    yield from batch
                    batch = ahead.result()
            finally:
                pool.submit(messages.close).result()

    def _in_order(
        self, topics: Collection[str] | None, start_ns: int | None, end_ns: int | None
    ) -> Any:  # noqa: ANN401  # a generator, to be closed
        num_read = 0
        try:
            with self._reader() as reader:
                chosen = [c for c in reader.connections if topics is None or c.topic in topics]
                found = reader.messages(chosen, start_ns, end_ns) if chosen else ()
                for connection, log_ns, data in found:
                    channel = self._channels[connection.id]
                    yield RawMessage(channel, log_ns, log_ns, num_read, memoryview(data))
                    num_read += 1
        except _DAMAGE as error:
            self._lose(str(error) or type(error).__name__, num_read)

    def _lose(self, reason: str, num_read: int) -> None:
        """Count what follows damage; rosbags cannot read on behind it."""
        where = f"after {num_read} messages" if num_read else "at the first message"
        loss = Loss(offset=0, reason=f"{reason} ({where}); nothing behind it was read")
        if loss not in self.losses:
            self.losses.append(loss)

    def close(self) -> None:
        """Nothing is held open between reads."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()


def _channel(connection: Connection) -> Channel:
    encoding = getattr(connection.ext, "serialization_format", "ros1")
    return Channel(
        topic=connection.topic,
        message_encoding=encoding,
        schema_name=connection.msgtype,
        schema_encoding="ros1msg" if encoding == "ros1" else "ros2msg",
        schema_data=str(connection.msgdef.data).encode(),
    )


def _topics(reader: _Reader, channels: dict[int, Channel]) -> dict[str, Topic]:
    """Return topics by name, with the times of a bag's index, or else those of the whole folder."""
    topics: dict[str, Topic] = {}
    for connection in reader.connections:
        first_ns, last_ns = reader.start_time, reader.end_time - 1
        if isinstance(reader, BagReader) and reader.indexes.get(connection.id):
            times = [entry.time for entry in reader.indexes[connection.id]]
            first_ns, last_ns = min(times), max(times)
        known = topics.get(connection.topic)
        topics[connection.topic] = Topic(
            channel=known.channel if known else channels[connection.id],
            count=connection.msgcount + (known.count if known else 0),
            first_ns=min(first_ns, known.first_ns) if known else first_ns,
            last_ns=max(last_ns, known.last_ns) if known else last_ns,
        )
    return topics
