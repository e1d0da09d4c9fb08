"""Damaged MCAP files: what is intact is read, what is not is counted, nothing raises half-way."""

import contextlib
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from mapstream.recordings.mcap_layout import from_summary
from mapstream.recordings.mcap_reader import McapRecording
from mapstream.streams.errors import RecordingError
from tests.recordings.made_mcap import Note, write_mcap

_CHUNKS = [[Note(k % 3, 10 * i + k, 20 + k) for k in range(9)] for i in range(5)]
_quiet = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def _whole_chunks(path: Path) -> dict[int, tuple[int, set[int]]]:
    """Return, by offset, where each chunk ends and the sequence numbers in it."""
    layout = from_summary(memoryview(path.read_bytes()))
    sequences = iter(range(45))
    return {
        s.offset: (s.data_start + s.data_size, {next(sequences) for _ in range(9)})
        for s in layout.segments
    }


def _read(path: Path) -> tuple[list[int], McapRecording]:
    with McapRecording(path) as recording:
        messages = list(recording.messages())
    notes = [note for chunk in _CHUNKS for note in chunk]
    for message in messages:
        assert bytes(message.data) == notes[message.sequence].data(message.sequence)
    times = [message.log_ns for message in messages]
    assert times == sorted(times)
    return [message.sequence for message in messages], recording


@_quiet
@given(data=st.data(), compression=st.sampled_from(CompressionType))
def test_a_truncated_file_is_read_up_to_its_end(
    tmp_path: Path, data: st.DataObject, compression: CompressionType
) -> None:
    path = write_mcap(tmp_path / "a.mcap", _CHUNKS, compression=compression)
    chunks, content = _whole_chunks(path), path.read_bytes()
    first_end = min(end for end, _ in chunks.values())
    size = data.draw(st.integers(first_end, len(content) - 1))
    path.write_bytes(content[:size])

    found, recording = _read(path)

    intact: set[int] = set().union(*(numbers for end, numbers in chunks.values() if end <= size))
    assert intact <= set(found)
    assert len(found) == len(set(found))
    assert recording.losses, "an unfinished file is said to be one"
    assert all(loss.reason for loss in recording.losses)


@_quiet
@given(data=st.data(), compression=st.sampled_from(CompressionType), has_summary=st.booleans())
def test_flipped_bytes_cost_no_more_than_their_chunk(
    tmp_path: Path, data: st.DataObject, compression: CompressionType, *, has_summary: bool
) -> None:
    path = write_mcap(tmp_path / "a.mcap", _CHUNKS, compression=compression)
    chunks, content = _whole_chunks(path), bytearray(path.read_bytes())
    if not has_summary:  # as a recorder leaves it that loses power
        del content[max(end for end, _ in chunks.values()) :]
    first = min(chunks) if has_summary else sorted(chunks)[1]  # the first one describes the topics
    position = data.draw(st.integers(first, len(content) - 1))
    content[position] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)

    found, recording = _read(path)

    hit = [offset for offset, (end, _) in chunks.items() if offset <= position < end]
    intact = set().union(*(numbers for offset, (_, numbers) in chunks.items() if offset not in hit))
    assert intact <= set(found)
    if len(found) < 45:
        assert recording.losses


@_quiet
@given(data=st.data())
def test_damage_between_messages_without_chunks_is_passed(
    tmp_path: Path, data: st.DataObject
) -> None:
    """Only the message that was hit, and the one before it, may be gone or changed."""
    path = write_mcap(tmp_path / "a.mcap", _CHUNKS, use_chunking=False, repeat_channels=True)
    content = bytearray(path.read_bytes())
    starts = [
        i
        for i in range(len(content))
        if content[i : i + 1] == b"\x05" and content[i + 4 : i + 9] == bytes(5)
    ]
    position = data.draw(st.integers(starts[0], starts[-1]))
    content[position] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)

    with McapRecording(path) as recording:
        found = [message.sequence for message in recording.messages()]

    assert len(set(found) & set(range(45))) >= 42


@pytest.mark.parametrize("claimed", [1, 2, 3, 10])
def test_a_length_that_claims_the_messages_behind_it_takes_none_of_them(
    tmp_path: Path, claimed: int
) -> None:
    """Even where it ends exactly where another message does."""
    path = write_mcap(tmp_path / "a.mcap", _CHUNKS, use_chunking=False, repeat_channels=True)
    content = bytearray(path.read_bytes())
    at = content.index(b"\x05" + (22 + 20).to_bytes(8, "little"))  # the first message
    end = at
    for _ in range(1 + claimed):
        end += 9 + int.from_bytes(content[end + 1 : end + 9], "little")
    content[at + 1 : at + 9] = (end - at - 9).to_bytes(8, "little")
    path.write_bytes(content)

    with McapRecording(path) as recording:
        found = [message.sequence for message in recording.messages()]
        (loss, *_) = recording.losses

    assert set(found) == set(range(1, 45))
    assert (loss.offset, loss.num_bytes) == (at, 9 + 22 + 20)


def test_a_message_that_holds_a_recording_is_one_message(tmp_path: Path) -> None:
    """What looks like records inside a payload is none."""
    inner = write_mcap(tmp_path / "inner.mcap", _CHUNKS, use_chunking=False).read_bytes()
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False)
        writer.start()
        channel_id = writer.register_channel("/file", "mcap", schema_id=0)
        for k in range(3):
            writer.add_message(channel_id, k, inner + bytes(k), k, k)
        writer.finish()  # type: ignore[no-untyped-call]  # the package has no types here

    with McapRecording(path) as recording:
        messages = list(recording.messages())

    assert [bytes(m.data) for m in messages] == [inner + bytes(k) for k in range(3)]
    assert not recording.losses


_damages = st.lists(
    st.tuples(
        st.sampled_from(["flip", "cut", "zero", "insert"]), st.floats(0, 0.999), st.integers(1, 60)
    ),
    min_size=1,
    max_size=12,
)


@_quiet
@given(damages=_damages, compression=st.sampled_from(CompressionType), has_chunks=st.booleans())
def test_whatever_the_damage_the_only_error_is_that_nothing_is_readable(
    tmp_path: Path,
    damages: list[tuple[str, float, int]],
    compression: CompressionType,
    *,
    has_chunks: bool,
) -> None:
    path = write_mcap(
        tmp_path / "a.mcap", _CHUNKS, compression=compression, use_chunking=has_chunks
    )
    content = bytearray(path.read_bytes())
    for kind, share, size in damages:
        at = int(share * len(content))
        if kind == "flip" and content:
            content[at] ^= size
        elif kind == "insert":
            content[at:at] = bytes(range(size))
        else:
            content[at : at + size] = b"" if kind == "cut" else bytes(size)
    path.write_bytes(content)

    found: list[int] = []
    with contextlib.suppress(RecordingError), McapRecording(path) as recording:
        found = [message.log_ns for message in recording.messages()]

    assert found == sorted(found)


def test_a_damaged_chunk_is_named_with_its_messages(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", _CHUNKS)
    content = bytearray(path.read_bytes())
    offset = sorted(_whole_chunks(path))[2]
    content[offset + 90] ^= 0xFF
    path.write_bytes(content)

    found, recording = _read(path)
    list(recording.losses)

    assert len(found) == 36
    (loss,) = recording.losses
    assert (loss.offset, loss.num_messages) == (offset, 9)
    assert loss.reason.startswith("chunk: ")


def test_topics_that_only_a_damaged_chunk_describes_are_kept(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", _CHUNKS, compression=CompressionType.NONE)
    chunks, content = _whole_chunks(path), bytearray(path.read_bytes())
    end = chunks[min(chunks)][0]
    del content[max(end for end, _ in chunks.values()) :]
    content[end - 1] ^= 0xFF  # in the last message of the first chunk
    path.write_bytes(content)

    found, recording = _read(path)

    assert found == list(range(9, 45))
    assert set(recording.topics) == {"/imu", "/points", "/image"}


def test_reading_twice_counts_a_loss_once(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", _CHUNKS)
    content = bytearray(path.read_bytes())
    content[sorted(_whole_chunks(path))[2] + 90] ^= 0xFF
    path.write_bytes(content)

    with McapRecording(path) as recording:
        for _ in range(2):
            assert len(list(recording.messages())) == 36
        assert len(recording.losses) == 1


def test_nothing_readable_is_an_error_that_names_the_place(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", _CHUNKS[:1])
    content = bytearray(path.read_bytes())
    (offset,) = _whole_chunks(path)
    content[offset + 90] ^= 0xFF
    path.write_bytes(content)

    with (
        McapRecording(path) as recording,
        pytest.raises(
            RecordingError, match=rf"a.mcap: nothing can be read.*byte {offset}; `mapstream doctor`"
        ),
    ):
        list(recording.messages())


def test_a_chunk_that_claims_too_much_is_not_allocated(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", _CHUNKS)
    chunks, content = _whole_chunks(path), bytearray(path.read_bytes())
    del content[max(end for end, _ in chunks.values()) :]
    offset = sorted(chunks)[1]
    content[offset + 25 : offset + 33] = (1 << 50).to_bytes(8, "little")
    path.write_bytes(content)

    found, recording = _read(path)

    assert len(found) == 36
    assert any("claims 1125899906842624 bytes" in loss.reason for loss in recording.losses)
