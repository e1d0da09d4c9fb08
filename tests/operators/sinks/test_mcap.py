"""What a graph writes to MCAP files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from mapstream.operators.sinks.mcap import McapSink, McapSinkConfig
from mapstream.operators.testing import run_operator
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.recording import open_recording
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import MapCorrection, Odometry, PointCloud
from tests.recordings.made_messages import one_of_each
from tests.recordings.test_message_codec import assert_same

pytestmark = pytest.mark.anyio


def _odometry(k: int) -> Odometry:
    return Odometry(stamp_ns=10**18 + k, T_odom_base=SE3.exp([0, 0, 0.1 * k, k, 0, 0]))


def _cloud(k: int) -> PointCloud:
    points = np.arange(12, dtype=np.float32).reshape(4, 3) + k
    return PointCloud(stamp_ns=10**18 + k, points=points, intensity=points[:, 0])


async def _write(path: Path, **options: Any) -> Path:  # noqa: ANN401
    topics: dict[str, Any] = {"odometry": "/odometry", "clouds": "/clouds"}
    config = McapSinkConfig(path=path, topics=topics, **options)
    odometry, clouds = [_odometry(k) for k in range(10)], [_cloud(k) for k in range(0, 10, 3)]
    await run_operator(McapSink(config), config=config, odometry=odometry, clouds=clouds)
    return path


async def test_S6_messages_come_back_in_stamp_order(tmp_path: Path) -> None:
    with open_recording(await _write(tmp_path / "a.mcap", schemas="mapstream")) as recording:
        found = [(m.topic, decoder_for(m.channel)(m)) for m in recording.messages()]

    assert [m.stamp_ns for _, m in found] == sorted(m.stamp_ns for _, m in found)
    for k, message in enumerate(m for topic, m in found if topic == "/odometry"):
        assert_same(message, _odometry(k))
    assert sum(topic == "/clouds" for topic, _ in found) == 4


async def test_S6_foxglove_schemas_are_those_of_foxglove(tmp_path: Path) -> None:
    """Read with Foxglove's own package, by the descriptors in the file, checksums on."""
    path = await _write(tmp_path / "a.mcap", schemas="foxglove")

    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        found = [
            (channel.topic, schema.name if schema else "", message)
            for schema, channel, _, message in reader.iter_decoded_messages()
        ]

    assert {(topic, name) for topic, name, _ in found} == {
        ("/foxglove/odometry", "foxglove.PoseInFrame"),
        ("/foxglove/odometry/transform", "foxglove.FrameTransform"),
        ("/foxglove/clouds", "foxglove.PointCloud"),
    }
    poses = [message for topic, _, message in found if topic == "/foxglove/odometry"]
    assert [pose.pose.position.x for pose in poses] == [
        _odometry(k).T_odom_base.t[0] for k in range(10)
    ]
    with open_recording(path) as recording:
        (first, *_) = recording.messages(["/foxglove/clouds"])
        cloud: Any = decoder_for(first.channel)(first)
    np.testing.assert_array_equal(cloud.points, _cloud(0).points)
    np.testing.assert_array_equal(cloud.intensity, _cloud(0).intensity)


async def test_every_message_of_ours_can_be_written(tmp_path: Path) -> None:
    messages = one_of_each(3)
    topics: dict[str, Any] = {
        f"port{i}": {"topic": f"/t{i}", "type": type(m).__name__} for i, m in enumerate(messages)
    }
    config = McapSinkConfig(path=tmp_path / "a.mcap", topics=topics)

    inputs: dict[str, Any] = {f"port{i}": [m] for i, m in enumerate(messages)}
    await run_operator(McapSink(config), config=config, **inputs)

    with open_recording(config.path) as recording:
        assert set(recording.topics) >= {f"/t{i}" for i in range(len(messages))}
        decoders = {
            n: decoder_for(t.channel)
            for n, t in recording.topics.items()
            if "PosesInFrame" not in t.schema_name
        }
        for raw in recording.messages(list(decoders)):
            assert decoders[raw.topic](raw).stamp_ns is not None


async def test_a_correction_shows_as_a_path(tmp_path: Path) -> None:
    correction = MapCorrection(
        stamp_ns=5, mission_id="0" * 32, stamps_ns=np.arange(3),
        T_mission_base=np.array([SE3.exp([0, 0, 0, k, 0, 0]).matrix for k in range(3)]),
        T_mission_odom=SE3.identity(),
    )  # fmt: skip
    config = McapSinkConfig(
        path=tmp_path / "a.mcap", topics={"corrections": "/corrections"}, schemas="foxglove"
    )

    await run_operator(McapSink(config), config=config, corrections=[correction])

    with config.path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        (found, *_) = reader.iter_decoded_messages(["/foxglove/corrections"])
    assert [pose.position.x for pose in found.decoded_message.poses] == [0.0, 1.0, 2.0]


async def test_equal_streams_give_equal_files(tmp_path: Path) -> None:
    a, b = await _write(tmp_path / "a.mcap"), await _write(tmp_path / "b.mcap")

    assert a.read_bytes() == b.read_bytes()
