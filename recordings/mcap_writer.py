"""Write messages to an MCAP file: mapstream's own schemas, or bytes that somebody else encoded.

The same messages in the same order give the same bytes. A file that was not closed, because the process
died, lacks its index; `McapRecording` reads all whole chunks of it.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import TracebackType
from typing import Final, Literal, Self

from mcap.writer import CompressionType, Writer

from mapstream.recordings.message_codec import encode
from mapstream.recordings.message_schema import schema_name, schema_of
from mapstream.recordings.recording import Channel
from mapstream.streams.errors import RecordingError
from mapstream.streams.messages.sensors import Message

Compression = Literal["zstd", "lz4", "none"]
_COMPRESSIONS: Final = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}


class McapWriter:
    """An MCAP file that is being written. Use it in a `with`, or close it."""

    def __init__(
        self, path: str | Path, *, compression: Compression = "zstd", chunk_bytes: int = 1 << 20
    ) -> None:
        """Create the file, and the folders that lead to it; an existing file is replaced.

        Raises:
            RecordingError: If it cannot be created.
        """
        self.path = Path(path)
        self.num_messages = 0
        self._channels: dict[str, tuple[Channel, int]] = {}
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._sequences: Counter[str] = Counter()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("wb")
        except OSError as error:
            raise self._error(error) from error
        self._writer = Writer(
            self._file, chunk_size=chunk_bytes, compression=_COMPRESSIONS[compression]
        )
        self._writer.start(library="mapstream")
        self._is_open = True

    def write(self, topic: str, message: Message, log_ns: int | None = None) -> None:
        """Write one of our messages, at its own stamp if no log time is given.

        Raises:
            RecordingError: If the topic holds another type already, or the disk is full.
        """
        cls = type(message)
        known = self._channels.get(topic)
        if known is None or known[0].schema_name != schema_name(cls):
            channel = Channel(
                topic=topic,
                message_encoding="protobuf",
                schema_name=schema_name(cls),
                schema_encoding="protobuf",
                schema_data=schema_of(cls),
            )
        else:
            channel = known[0]
        self.write_raw(channel, encode(message), message.stamp_ns if log_ns is None else log_ns)

    def write_raw(self, channel: Channel, data: bytes | memoryview, log_ns: int) -> None:
        """Write encoded bytes to a channel.

        Raises:
            RecordingError: If the topic holds another schema already, the time is negative, or the
                disk is full.
        """
        if not 0 <= log_ns < 2**63:
            raise RecordingError(
                f"{self.path}: {channel.topic}: {log_ns} ns is no time that MCAP can hold"
            )
        channel_id = self._channel_id(channel)
        sequence = self._sequences[channel.topic]
        self._sequences[channel.topic] += 1
        try:
            self._writer.add_message(channel_id, log_ns, bytes(data), log_ns, sequence)
        except OSError as error:
            raise self._error(error) from error
        self.num_messages += 1

    def _channel_id(self, channel: Channel) -> int:
        if not self._is_open:
            raise RecordingError(f"{self.path}: was closed")
        known = self._channels.get(channel.topic)
        if known is not None:
            if known[0] is channel or known[0] == channel:
                return known[1]
            raise RecordingError(
                f"{self.path}: topic {channel.topic} holds {known[0].schema_name}; "
                f"give {channel.schema_name} a topic of its own"
            )
        key = (channel.schema_name, channel.schema_data)
        if channel.schema_name and key not in self._schemas:
            self._schemas[key] = self._writer.register_schema(
                channel.schema_name, channel.schema_encoding, channel.schema_data
            )
        channel_id = self._writer.register_channel(
            channel.topic, channel.message_encoding, self._schemas.get(key, 0)
        )
        self._channels[channel.topic] = (channel, channel_id)
        return channel_id

    def attach(self, name: str, content: bytes, *, media_type: str = "text/plain") -> None:
        """Put a file, such as a calibration or a graph, into the recording; its times are zero.

        Raises:
            RecordingError: If the disk is full.
        """
        try:
            self._writer.add_attachment(0, 0, name, media_type, content)
        except OSError as error:
            raise self._error(error) from error

    def close(self) -> None:
        """Write the index and close the file.

        Raises:
            RecordingError: If the disk is full; what was written before can still be read.
        """
        if not self._is_open:
            return
        self._is_open = False
        try:
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]  # the package has no types here
            finally:
                self._file.close()
        except OSError as error:
            raise self._error(error) from error

    def _error(self, error: OSError) -> RecordingError:
        return RecordingError(
            f"{self.path}: cannot be written after {self.num_messages} messages: {error.strerror}"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
