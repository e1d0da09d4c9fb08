"""What we write, we and others can read."""

from pathlib import Path

import pytest
from mcap.reader import make_reader

from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.mcap_writer import Compression, McapWriter
from mapstream.recordings.recording import Channel, open_recording
from mapstream.streams.errors import RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from tests.recordings.made_messages import one_of_each
from tests.recordings.test_message_codec import assert_same


def _odometry(stamp_ns: int) -> Odometry:
    return Odometry(stamp_ns=stamp_ns, T_odom_base=SE3.exp([0, 0, 0.1, stamp_ns, 0, 0]))


def _write(path: Path, compression: Compression = "zstd") -> Path:
    with McapWriter(path, compression=compression) as writer:
        for k in range(10):
            writer.write("/odometry", _odometry(100 + k))
        for i, message in enumerate(one_of_each(1)):
            writer.write(f"/topic{i}", message, log_ns=200 + i)
        writer.attach("graph.yaml", b"version: 1")
    return path


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_S6_our_messages_come_back_from_a_recording(
    tmp_path: Path, compression: Compression
) -> None:
    path = _write(tmp_path / "sub" / "out.mcap", compression)

    with open_recording(path) as recording:
        found = [(m.log_ns, decoder_for(m.channel)(m)) for m in recording.messages()]

    expected = [(100 + k, _odometry(100 + k)) for k in range(10)]
    expected += [(200 + i, message) for i, message in enumerate(one_of_each(1))]
    assert [log_ns for log_ns, _ in found] == [log_ns for log_ns, _ in expected]
    for (_, a), (_, b) in zip(found, expected, strict=True):
        assert_same(a, b)


def test_S6_the_mcap_package_reads_what_we_write(tmp_path: Path) -> None:
    from mcap_protobuf.decoder import DecoderFactory  # noqa: PLC0415  # needed here alone

    with _write(tmp_path / "out.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        found = [m.decoded_message for m in reader.iter_decoded_messages(["/odometry"])]
        names = [attachment.name for attachment in reader.iter_attachments()]

    assert [message.stamp_ns for message in found] == list(range(100, 110))
    assert list(found[3].T_odom_base.matrix) == _odometry(103).T_odom_base.matrix.ravel().tolist()
    assert names == ["graph.yaml"]


def test_equal_messages_give_equal_files(tmp_path: Path) -> None:
    assert _write(tmp_path / "a.mcap").read_bytes() == _write(tmp_path / "b.mcap").read_bytes()


def test_a_file_that_was_not_closed_reads_up_to_its_last_chunk(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    writer = McapWriter(path, chunk_bytes=1000)
    for k in range(500):
        writer.write("/odometry", _odometry(k))
    with path.open("rb") as file:
        written = file.read()
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(written)
    writer.close()

    with open_recording(copy) as recording:
        found = [m.log_ns for m in recording.messages()]

    assert found == list(range(len(found)))
    assert len(found) > 0
    assert recording.losses[0].reason == "summary: no footer, the file was not finished"


def test_refusals(tmp_path: Path) -> None:
    writer = McapWriter(tmp_path / "a.mcap")
    writer.write("/x", _odometry(1))
    other = Channel(topic="/x", message_encoding="cdr", schema_name="sensor_msgs/msg/Imu")

    with pytest.raises(
        RecordingError, match=r"topic /x holds mapstream.Odometry; give sensor_msgs"
    ):
        writer.write_raw(other, b"", 1)
    with pytest.raises(RecordingError, match=r"/y: -5 ns is no time that MCAP can hold"):
        writer.write("/y", _odometry(-5))
    writer.close()
    writer.close()
    with pytest.raises(RecordingError, match=r"a.mcap: was closed"):
        writer.write("/x", _odometry(2))
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot be written after 0 messages"):
        McapWriter(tmp_path / "file" / "a.mcap")


def test_a_full_disk_is_an_error_that_says_so() -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full on this system")

    def fill() -> None:
        with McapWriter("/dev/full", chunk_bytes=100) as writer:
            for k in range(2000):
                writer.write("/x", _odometry(k))

    with pytest.raises(RecordingError, match=r"/dev/full: cannot be written.*No space left"):
        fill()
