"""What every recording is, whatever the file: topics, messages in log-time order, and what was lost."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from mapstream.streams.errors import RecordingError

MCAP_MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """How the messages of a topic are written; two writers of one topic are two channels."""

    topic: str
    message_encoding: str  # cdr, ros1, protobuf, json ...
    schema_name: str = ""  # sensor_msgs/msg/Imu, foxglove.PointCloud ...; empty without a schema
    schema_encoding: str = ""  # ros2msg, ros1msg, protobuf, jsonschema ...
    schema_data: bytes = field(default=b"", repr=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Topic:
    """One topic of a recording, and how much of it there is."""

    channel: Channel
    count: int  # messages, as the index says; damage may take some of them
    first_ns: int  # log times
    last_ns: int

    @property
    def name(self) -> str:
        return self.channel.topic

    @property
    def schema_name(self) -> str:
        return self.channel.schema_name

    @property
    def schema_encoding(self) -> str:
        return self.channel.schema_encoding

    @property
    def message_encoding(self) -> str:
        return self.channel.message_encoding

    @property
    def frequency(self) -> float:
        """Messages per second; zero where one message, or one instant, says nothing."""
        span_ns = self.last_ns - self.first_ns
        return (self.count - 1) * 1e9 / span_ns if span_ns > 0 else 0.0


@dataclass(slots=True)
class RawMessage:
    """One recorded message. `data` may be a view that keeps a whole chunk in memory."""

    channel: Channel
    log_ns: int
    publish_ns: int
    sequence: int
    data: memoryview

    @property
    def topic(self) -> str:
        return self.channel.topic


@dataclass(frozen=True, slots=True, kw_only=True)
class Loss:
    """Something that the file once held and that cannot be read."""

    offset: int  # in the file [bytes]
    reason: str
    topic: str | None = None  # None: several, or nobody knows
    num_messages: int | None = None  # None: nobody knows
    num_bytes: int | None = None  # in the file


class Recording(Protocol):
    """A recorded run. It is its own context manager; messages stay valid after `close`."""

    path: Path
    topics: dict[str, Topic]
    start_ns: int  # log time of the first message; 0 without one
    end_ns: int  # log time of the last message
    losses: list[Loss]  # grows while messages are read

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[RawMessage]:
        """Yield messages in log-time order, from `start_ns` on and before `end_ns`.

        Raises:
            RecordingError: If a topic is not in the recording, or nothing could be read.
        """
        ...

    def close(self) -> None: ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None: ...


def open_recording(path: str | Path) -> Recording:
    """Open an MCAP file, a ROS 1 bag, a rosbag2 database or the folder that holds one.

    The first bytes decide, not the name.

    Raises:
        RecordingError: If there is nothing at the path, or it is no recording that we know.
    """
    path = Path(path)
    if path.is_dir():
        files = sorted(path.glob("*.mcap"))
        if len(files) == 1:  # a rosbag2 folder around one MCAP file
            return _open_mcap(files[0])
        if not (path / "metadata.yaml").is_file():
            what = (
                f"{len(files)} .mcap files" if files else "neither metadata.yaml nor an .mcap file"
            )
            raise RecordingError(f"{path}: a folder with {what}; give one recording")
        return _open_rosbag(path)
    if not path.is_file():
        raise RecordingError(f"{path}: no such file; give an .mcap, a .bag, a .db3 or its folder")
    with path.open("rb") as file:
        start = file.read(16)
    if start.startswith(MCAP_MAGIC) or path.suffix == ".mcap":
        return _open_mcap(path)
    if start.startswith((b"#ROSBAG V", b"SQLite format 3\0")) or path.suffix in (".bag", ".db3"):
        return _open_rosbag(path)
    raise RecordingError(
        f"{path}: not a recording: expected MCAP, ROS 1 bag or rosbag2, found a file that "
        f"starts with {start[:8]!r}; `mapstream convert` reads other formats"
    )


def check_topics(path: Path, wanted: Collection[str] | None, known: Collection[str]) -> None:
    """Refuse topics that a recording does not have.

    Raises:
        RecordingError: With the topics that there are.
    """
    missing = sorted(set(wanted or ()) - set(known))
    if missing:
        there = ", ".join(sorted(known)) or "none"
        raise RecordingError(f"{path}: no topic {', '.join(missing)}; there are: {there}")


def _open_mcap(path: Path) -> Recording:
    from mapstream.recordings.mcap_reader import McapRecording  # noqa: PLC0415  # it imports this

    return McapRecording(path)


def _open_rosbag(path: Path) -> Recording:
    from mapstream.recordings.rosbag import RosbagRecording  # noqa: PLC0415  # heavy, and it imports this

    return RosbagRecording(path)
