"""ROS bags read as MCAP files do."""

import hashlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapFile
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import Writer as FolderWriter

from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.message_codec import encode
from mapstream.recordings.recording import RawMessage, open_recording
from mapstream.streams.errors import DecodeError, RecordingError
from tests.data import shared
from tests.recordings.decoding.made_ros import cloud, imu, store


def _messages(encoding: str) -> list[RawMessage]:
    points = np.zeros(50, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
    points["x"], points["t"] = np.arange(50), np.arange(50) * 1000
    found = []
    for k in range(100):
        found.append(imu(encoding, k))
        if k % 10 == 0:
            found.append(cloud(encoding, points[: k // 2]))
    return found


def _write_bag(path: Path) -> Path:
    messages = _messages("ros1")
    with BagWriter(path) as writer:
        known: dict[str, Any] = {}
        for k, message in enumerate(messages):
            if message.topic not in known:
                known[message.topic] = writer.add_connection(
                    message.topic, message.channel.schema_name, typestore=store("ros1")
                )
            writer.write(known[message.topic], 1000 + k, bytes(message.data))
    return path


def _write_folder(path: Path) -> Path:
    with FolderWriter(path, version=9) as writer:
        known: dict[str, Any] = {}
        for k, message in enumerate(_messages("cdr")):
            if message.topic not in known:
                known[message.topic] = writer.add_connection(
                    message.topic, message.channel.schema_name, typestore=store("cdr")
                )
            writer.write(known[message.topic], 1000 + k, bytes(message.data))
    return path


def _write_mcap(path: Path) -> Path:
    with path.open("wb") as file:
        writer = McapFile(file)
        writer.start("ros2")
        known: dict[str, int] = {}
        for k, message in enumerate(_messages("cdr")):
            if message.topic not in known:
                schema = writer.register_schema(message.channel.schema_name, "ros2msg", b"")
                known[message.topic] = writer.register_channel(message.topic, "cdr", schema)
            writer.add_message(known[message.topic], 1000 + k, bytes(message.data), 1000 + k)
        writer.finish()  # type: ignore[no-untyped-call]  # the package has no types here
    return path


def _stream_hash(path: Path) -> str:
    """Hash what a graph sees of a recording: topics, log times and decoded messages, in order."""
    digest = hashlib.blake2b()
    with open_recording(path) as recording:
        decoders = {name: decoder_for(topic.channel) for name, topic in recording.topics.items()}
        for raw in recording.messages():
            digest.update(f"{raw.topic} {raw.log_ns} ".encode())
            digest.update(encode(decoders[raw.topic](raw)))
    return digest.hexdigest()


def test_A23_bag_db3_and_mcap_of_the_same_data_give_the_same_stream_hash(tmp_path: Path) -> None:
    bag, folder = _write_bag(tmp_path / "a.bag"), _write_folder(tmp_path / "folder")
    mcap = _write_mcap(tmp_path / "a.mcap")
    (database,) = folder.glob("*.db3")

    hashes = {_stream_hash(path) for path in (bag, folder, database, mcap)}

    assert len(hashes) == 1


def test_A23_no_ros_package_is_imported(tmp_path: Path) -> None:
    program = (
        "import sys; from mapstream.recordings.recording import open_recording; "
        f"print(len(list(open_recording({str(_write_bag(tmp_path / 'a.bag'))!r}).messages()))); "
        "print([m for m in sys.modules if m.split('.')[0] in ('rclpy', 'rospy', 'rosbag', 'rosbag2_py')])"
    )

    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )

    assert done.stdout.split("\n")[:2] == ["110", "[]"]


@pytest.mark.parametrize("write", [_write_bag, _write_folder])
def test_topics_and_times_are_chosen(tmp_path: Path, write: Any) -> None:  # noqa: ANN401
    with open_recording(write(tmp_path / "a.bag")) as recording:
        topic = recording.topics["/points"]
        found = [m.log_ns for m in recording.messages(["/points"], start_ns=1011, end_ns=1044)]

        assert topic.count == 10
        assert found == [1012, 1023, 1034]
        assert (recording.start_ns, recording.end_ns) == (1000, 1109)
        with pytest.raises(RecordingError, match=r"no topic /x; there are: /imu, /points"):
            recording.messages(["/x"])


def test_a_reader_may_stop_early(tmp_path: Path) -> None:
    with open_recording(_write_folder(tmp_path / "a")) as recording:
        messages = recording.messages()
        assert next(messages).log_ns == 1000
        messages.close()  # type: ignore[attr-defined]  # it is a generator


def test_a_truncated_bag_says_what_to_try(tmp_path: Path) -> None:
    path = _write_bag(tmp_path / "a.bag")
    path.write_bytes(path.read_bytes()[:-500])

    with pytest.raises(RecordingError, match=r"a.bag: .*rosbag reindex"):
        open_recording(path)


def test_a_bag_with_a_damaged_chunk_is_read_up_to_it(tmp_path: Path) -> None:
    path = _write_bag(tmp_path / "a.bag")
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 2000] = bytes(2000)
    path.write_bytes(content)

    with open_recording(path) as recording:
        found = list(recording.messages())

    assert 0 < len(found) < 110
    assert len(recording.losses) == 1
    assert "nothing behind it was read" in recording.losses[0].reason


def test_A23_a_real_bag_and_its_mcap_say_the_same() -> None:
    bag, mcap = shared("husky/husky_ros1.bag"), shared("husky/husky_imu_odom_gps.mcap")
    with open_recording(bag) as a, open_recording(mcap) as b:
        assert {n: t.count for n, t in a.topics.items()} == {
            n: t.count for n, t in b.topics.items()
        }
        decoders = [{n: decoder_for(t.channel) for n, t in r.topics.items()} for r in (a, b)]
        num_equal = 0
        for x, y in zip(a.messages(["/imu/data"]), b.messages(["/imu/data"]), strict=True):
            assert (x.topic, x.log_ns) == (y.topic, y.log_ns)
            if num_equal < 300:  # decoding all would take seconds
                assert encode(decoders[0][x.topic](x)) == encode(decoders[1][y.topic](y))
            num_equal += 1

    assert num_equal == 11865


def test_raw_packets_have_no_decoder_and_say_so() -> None:
    (folder,) = shared("velodyne_packets_db3").glob("*/")

    with open_recording(folder) as recording:
        (topic,) = recording.topics.values()

        assert topic.count == len(list(recording.messages())) > 0
        with pytest.raises(
            DecodeError,
            match=r"/velodyne_packets: no decoder for schema 'velodyne_msgs/VelodyneScan'",
        ):
            decoder_for(topic.channel)
