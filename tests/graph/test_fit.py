"""A graph is held against the recording that it will read."""

from __future__ import annotations

from pathlib import Path

import pytest

from mapstream.graph.fit import check_fit, propose_topics, topics_for
from mapstream.graph.load import Graph, parse_graph
from mapstream.graph.plan import plan
from mapstream.graph.problems import GraphError
from mapstream.operators.samples import samples
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import open_recording
from mapstream.streams.messages.sensors import (
    CameraFrame,
    ImuBatch,
    LaserScan2D,
    LidarScan,
    Message,
)

GRAPH = """\
version: 1
name: odometry
operators:
  sensors: {use: mcap, config: {path: $recording, topics: {scans: /points}}}
  odometry: {use: kiss_odometry, in: {scans: sensors.scans}}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path


def recording(folder: Path, **topics: type[Message]) -> Path:
    file = folder / "drive.mcap"
    with McapWriter(file) as writer:
        for topic, kind in topics.items():
            for message in samples(kind):
                writer.write(f"/{topic}", message)
    return file


def graph_for(file: Path, text: str = GRAPH) -> Graph:
    return parse_graph(text, params={"recording": str(file)})


def fit(file: Path, text: str = GRAPH) -> list[str]:
    graph = graph_for(file, text)
    with open_recording(file) as opened:
        return check_fit(plan(graph), graph.positions, opened)


def test_tells_rate_and_type(folder: Path) -> None:
    assert fit(recording(folder, points=LidarScan)) == ["/points: 5 messages, 10 Hz, LidarScan"]


@pytest.mark.parametrize(
    ("topics", "message"),
    [
        (
            {"os_points": LidarScan},
            "4:60: operators.sensors.config.topics.scans: {file} has no topic '/points'; did you mean",
        ),
        ({"imu": ImuBatch}, "has no topic '/points'; there is /imu"),
        (
            {"points": LaserScan2D},
            "/points is mapstream.LaserScan2D, read as LaserScan2D, not LidarScan",
        ),
    ],
)
def test_B17_refusal_names_the_line_and_the_topic(
    topics: dict[str, type[Message]], message: str, folder: Path
) -> None:
    file = recording(folder, **topics)

    with pytest.raises(GraphError) as caught:
        fit(file)

    assert message.format(file=file) in str(caught.value)


def test_recording_that_no_operator_reads(folder: Path) -> None:
    file = recording(folder, points=LidarScan)
    graph = parse_graph(GRAPH.replace("$recording", "other.mcap"))

    with open_recording(file) as opened:
        notes = check_fit(plan(graph), graph.positions, opened)

    assert notes == [f"no operator of odometry reads {file}"]


class TestProposals:
    def test_the_one_topic_of_the_type_is_taken(self, folder: Path) -> None:
        file = recording(folder, os_points=LidarScan, imu=ImuBatch)

        with open_recording(file) as opened:
            sets, remarks = propose_topics(plan(graph_for(file)), opened)

        assert sets == ["sensors.topics.scans=/os_points"]
        assert remarks == ["reading /os_points (mapstream.LidarScan); there is no /points"]

    def test_what_is_there_stays(self, folder: Path) -> None:
        file = recording(folder, points=LidarScan, other=LidarScan)

        with open_recording(file) as opened:
            assert propose_topics(plan(graph_for(file)), opened) == ([], [])

    @pytest.mark.parametrize(
        ("topics", "reason"),
        [
            (
                {"left": LidarScan, "right": LidarScan},
                "several of type LidarScan: /left, /right; choose with --set sensors.topics.scans=",
            ),
            ({"imu": ImuBatch}, "no topic '/points', and none of type LidarScan; there is /imu"),
        ],
    )
    def test_refusal(self, topics: dict[str, type[Message]], reason: str, folder: Path) -> None:
        file = recording(folder, **topics)

        with open_recording(file) as opened, pytest.raises(GraphError) as caught:
            propose_topics(plan(graph_for(file)), opened)

        assert reason in str(caught.value)


def test_topics_of_a_type(folder: Path) -> None:
    file = recording(folder, cam=CameraFrame, imu=ImuBatch)

    with open_recording(file) as opened:
        assert [topic.name for topic in topics_for(CameraFrame, opened)] == ["/cam"]
