"""A first graph is proposed from what is in a recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from mapstream.graph.load import Graph, parse_graph
from mapstream.graph.plan import plan
from mapstream.graph.propose import propose_graph
from mapstream.operators.samples import samples
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import open_recording
from mapstream.streams.errors import RecordingError
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import EncodedImage, ImuBatch, LidarScan, Message


def recording(tmp_path: Path, **topics: type[Message]) -> Path:
    file = tmp_path / "a drive.mcap"
    with McapWriter(file) as writer:
        for topic, kind in topics.items():
            for message in samples(kind):
                writer.write(f"/{topic}", message)
    return file


def proposed(file: Path) -> Graph:
    with open_recording(file) as opened:
        return parse_graph(propose_graph(opened))


@pytest.mark.parametrize(
    ("topics", "operators"),
    [
        ({"points": LidarScan}, {"kiss_odometry", "lidar_loops"}),
        ({"points": LidarScan, "imu": ImuBatch}, {"gicp_odometry", "lidar_loops"}),
        ({"points": LidarScan, "cam": EncodedImage}, {"kiss_odometry", "image_decode", "orb"}),
        ({"odom": Odometry}, {"keyframes", "optimizer"}),
    ],
)
def test_proposal_can_be_planned(
    topics: dict[str, type[Message]], operators: set[str], tmp_path: Path
) -> None:
    graph = proposed(recording(tmp_path, **topics))

    planned = plan(graph)

    assert operators | {"map_store", "trajectory_sink"} <= {n.use for n in planned.nodes.values()}
    assert graph.spec.name == "a_drive"


def test_nothing_to_map(tmp_path: Path) -> None:
    file = recording(tmp_path, imu=ImuBatch)

    with pytest.raises(RecordingError, match=r"no LiDAR and no odometry that can be read.*Imu"):
        proposed(file)
