"""A trajectory is read from maps, recordings and text files alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.graph.trajectory_sources import read_trajectory
from mapstream.operators.samples import samples
from mapstream.recordings.maps import Map, save_map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.trajectory_files import write_euroc, write_kitti, write_tum
from mapstream.streams.errors import MapError, RecordingError
from mapstream.streams.messages.estimates import Odometry, Submap
from mapstream.streams.trajectory import Trajectory

ODOMETRY: list[Odometry] = samples(Odometry)
TRAJECTORY = Trajectory(
    stamps_ns=np.array([m.stamp_ns for m in ODOMETRY]),
    poses=np.array([m.T_odom_base.matrix for m in ODOMETRY]),
)


@pytest.mark.parametrize("write", [write_tum, write_kitti, write_euroc])
def test_text_files_are_told_apart_by_their_lines(write: object, tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    write(file, TRAJECTORY)  # type: ignore[operator]  # one of the three

    assert np.allclose(read_trajectory(file).poses, TRAJECTORY.poses)


def recording(tmp_path: Path, *topics: str) -> Path:
    file = tmp_path / "drive.mcap"
    with McapWriter(file) as writer:
        for topic in topics:
            for message in ODOMETRY:
                writer.write(topic, message)
    return file


@pytest.mark.parametrize(
    ("topics", "topic"), [(["/odom"], None), (["/odom", "/truth"], None), (["/a", "/b"], "/b")]
)
def test_recording(topics: list[str], topic: str | None, tmp_path: Path) -> None:
    found = read_trajectory(recording(tmp_path, *topics), topic=topic)

    assert found.stamps_ns.tolist() == TRAJECTORY.stamps_ns.tolist()


def test_recording_with_a_choice(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no topic is given; topics with poses: /a, /b;"):
        read_trajectory(recording(tmp_path, "/a", "/b"))


def test_map(tmp_path: Path) -> None:
    save_map(append_submap(Map.empty(), samples(Submap, 1)[0]), tmp_path / "map")

    assert len(read_trajectory(tmp_path / "map")) == 2


def test_mission_that_is_not_there(tmp_path: Path) -> None:
    save_map(append_submap(Map.empty(), samples(Submap, 1)[0]), tmp_path / "map")

    with pytest.raises(MapError, match="has 0 missions that start with 'ff': 0000000000000000000"):
        read_trajectory(tmp_path / "map", mission="ff")


@pytest.mark.parametrize("text", ["", "1 2 3\n", "\x00\xff"])
def test_file_that_is_no_trajectory(text: str, tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    file.write_text(text)

    with pytest.raises(RecordingError, match=r"poses\.txt: no trajectory: expected 8 numbers"):
        read_trajectory(file)
