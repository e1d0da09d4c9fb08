"""Reading MCAP files, with the `mcap` package as the oracle."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from mapstream.recordings.mcap_reader import McapRecording
from mapstream.recordings.recording import open_recording
from mapstream.streams.errors import RecordingError
from tests.data import shared
from tests.recordings.made_mcap import TOPICS, Note, write_mcap

_notes = st.builds(Note, st.integers(0, 2), st.integers(0, 60), st.integers(0, 50))
_files = st.lists(st.lists(_notes, min_size=1, max_size=8), max_size=6)
_quiet = settings(
    max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def _oracle(
    path: Path, topics: Sequence[str] | None, start_ns: int | None, end_ns: int | None
) -> list[tuple[str, int, bytes]]:
    if start_ns is not None and end_ns is not None and end_ns < start_ns:
        return []  # the package refuses to answer
    with path.open("rb") as file:
        found = make_reader(file).iter_messages(topics, starting_at=start_ns, ending_before=end_ns)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in found]


@_quiet
@given(
    chunks=_files,
    compression=st.sampled_from(CompressionType),
    topics=st.none() | st.lists(st.sampled_from(TOPICS), min_size=1, unique=True),
    start_ns=st.none() | st.integers(0, 60),
    end_ns=st.none() | st.integers(0, 60),
)
def test_order_topics_and_times_are_those_of_the_mcap_package(
    tmp_path: Path,
    chunks: list[list[Note]],
    compression: CompressionType,
    topics: list[str] | None,
    start_ns: int | None,
    end_ns: int | None,
) -> None:
    """Chunks overlap at will; ties keep the order of the file."""
    path = write_mcap(tmp_path / "a.mcap", chunks, compression=compression)
    present = {TOPICS[note.topic] for chunk in chunks for note in chunk}

    with McapRecording(path) as recording:
        found = list(recording.messages(topics, start_ns, end_ns))

    assert set(recording.topics) == set(TOPICS) >= present
    expected = _oracle(path, topics, start_ns, end_ns)
    assert [(m.topic, m.log_ns, bytes(m.data)) for m in found] == expected
    assert recording.losses == []


@_quiet
@given(chunks=_files.filter(bool))
def test_topics_say_what_is_there(tmp_path: Path, chunks: list[list[Note]]) -> None:
    notes = [note for chunk in chunks for note in chunk]

    with McapRecording(write_mcap(tmp_path / "a.mcap", chunks)) as recording:
        found = {name: (t.count, t.first_ns, t.last_ns) for name, t in recording.topics.items()}

    for i, topic in enumerate(TOPICS):
        times = [note.log_ns for note in notes if note.topic == i]
        assert found[topic] == (len(times), min(times, default=0), max(times, default=0))
    assert recording.start_ns == min(note.log_ns for note in notes)
    assert recording.end_ns == max(note.log_ns for note in notes)


_CHUNKS = [[Note(k % 3, 10 * i + k) for k in range(9)] for i in range(4)]


@pytest.mark.parametrize(
    "options",
    [
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"repeat_channels": False},
        {"repeat_schemas": False},
        {"use_statistics": False},
        {"use_chunking": False},
        {"use_chunking": False, "enable_data_crcs": True},
        {"enable_crcs": False},
    ],
)
def test_a_file_without_some_of_its_index_reads_the_same(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    expected = _oracle(write_mcap(tmp_path / "whole.mcap", _CHUNKS), None, None, None)

    with McapRecording(write_mcap(tmp_path / "less.mcap", _CHUNKS, **options)) as recording:
        found = [(m.topic, m.log_ns, bytes(m.data)) for m in recording.messages()]

    assert found == expected
    assert recording.losses == []
    assert recording.topics["/imu"].schema_name == "Note"
    assert recording.topics["/imu"].count == 12


def test_messages_outlive_the_recording(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", _CHUNKS, compression=CompressionType.NONE)

    with McapRecording(path) as recording:
        message = next(iter(recording.messages()))

    assert bytes(message.data) == _CHUNKS[0][0].data(0)


def test_a_reader_may_stop_early(tmp_path: Path) -> None:
    with McapRecording(write_mcap(tmp_path / "a.mcap", _CHUNKS)) as recording:
        first = recording.messages()
        assert next(first).log_ns == 0
        first.close()  # type: ignore[attr-defined]  # it is a generator

        assert len(list(recording.messages())) == 36


def test_a_schema_of_no_id_leaves_the_name_empty(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/raw", "bytes", schema_id=0)
        writer.add_message(channel, 5, b"x", 5)
        writer.finish()  # type: ignore[no-untyped-call]  # the package has no types here

    with McapRecording(path) as recording:
        assert recording.topics["/raw"].schema_name == ""
        assert [m.log_ns for m in recording.messages()] == [5]


def test_attachments_are_read_and_checked(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", _CHUNKS)
    with McapRecording(path) as recording:
        assert recording.attachment("calibration.yaml") == b"camera: none"
        with pytest.raises(RecordingError, match=r"no attachment 'x'; there are: calibration.yaml"):
            recording.attachment("x")

    broken = path.read_bytes().replace(b"camera: none", b"camera: nine")
    path.write_bytes(broken)
    with McapRecording(path) as recording, pytest.raises(RecordingError, match="CRC"):
        recording.attachment("calibration.yaml")


def test_refusals_name_the_file_and_what_to_try(tmp_path: Path) -> None:
    empty, other = tmp_path / "empty.mcap", tmp_path / "notes.txt"
    empty.write_bytes(b"")
    other.write_bytes(b"hello there")

    with pytest.raises(RecordingError, match=r"empty.mcap: the file is empty"):
        open_recording(empty)
    with pytest.raises(RecordingError, match=r"notes.txt: not a recording.*b'hello th"):
        open_recording(other)
    with pytest.raises(RecordingError, match=r"none.mcap: no such file"):
        open_recording(tmp_path / "none.mcap")
    path = write_mcap(tmp_path / "a.mcap", _CHUNKS)
    with (
        open_recording(path) as recording,
        pytest.raises(RecordingError, match=r"no topic /x; there are: /image, /imu, /points"),
    ):
        recording.messages(["/x"])
    with pytest.raises(RecordingError, match="was closed"):
        recording.messages()


def test_a_file_of_garbage_is_no_recording(tmp_path: Path) -> None:
    path = tmp_path / "garbage.mcap"
    path.write_bytes(bytes(range(256)) * 20)

    with pytest.raises(RecordingError, match=r"garbage.mcap: no message can be read: at byte 0"):
        McapRecording(path)


def test_an_empty_recording_is_no_error(tmp_path: Path) -> None:
    with McapRecording(write_mcap(tmp_path / "a.mcap", [])) as recording:
        assert list(recording.messages()) == []
        assert (recording.start_ns, recording.end_ns) == (0, 0)


def test_a_real_recording_reads_as_with_the_mcap_package() -> None:
    path = shared("kitti_camera_lidar/kitti_camera_lidar.mcap")

    with open_recording(path) as recording:
        found = [(m.topic, m.log_ns, bytes(m.data)) for m in recording.messages()]

    assert found == _oracle(path, None, None, None)
    assert recording.topics["/velodyne_points"].frequency == pytest.approx(10.0, rel=0.01)
