"""`mapstream localize` with a map of planes and a recording with depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.graph.cli.localize_planes import is_for_planes, planes_graph
from mapstream.graph.cli.planning import Request, plan_request
from mapstream.recordings.maps import Map, save_map
from mapstream.recordings.maps.build import new_mission
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.recordings.recording import open_recording
from mapstream.streams.errors import ConfigError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, LandmarkRef
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import CameraFrame
from tests.operators.estimation.problems import with_constraints, with_mission

IMAGE = np.full((6, 8), 2000, np.uint16)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    wall = Constraint(stamp_ns=1, kind="plane", landmark=LandmarkRef(name="wall", kind="plane"))
    save_map(with_constraints(with_mission(np.eye(4)[None]), [wall]), tmp_path / "m")
    return tmp_path / "m"


def recorded(path: Path, *topics: str) -> Path:
    with McapWriter(path) as writer:
        for topic in topics:
            depth = CameraFrame(stamp_ns=1, image=IMAGE, encoding="16UC1")
            odometry = Odometry(stamp_ns=1, T_odom_base=SE3.identity())
            writer.write(topic, odometry if topic == "/odometry" else depth, 1)
    return path


@pytest.mark.parametrize("moves", [None, "/odometry"])
def test_U1_depth_is_localised_by_planes_with_odometry_or_dense_visual_odometry(
    folder: Path, tmp_path: Path, moves: str | None
) -> None:
    file = recorded(tmp_path / "r.mcap", "/color/image", "/depth/image", "/odometry")

    with open_recording(file) as recording:
        assert is_for_planes(folder, recording)
        text = planes_graph(folder, recording, moves).replace("OUT", str(tmp_path / "out.mcap"))
    (tmp_path / "graph.yaml").write_text(text)
    request = Request(graph=str(tmp_path / "graph.yaml"), recording=file, sets=[])
    nodes = set(plan_request(request).plan.nodes)

    assert {"planes", "localize", "poses"} <= nodes
    assert ("dense" in nodes) == (moves is None)


def test_U1_depth_without_odometry_or_colour_is_refused(folder: Path, tmp_path: Path) -> None:
    with open_recording(recorded(tmp_path / "r.mcap", "/depth/image")) as recording:
        with pytest.raises(ConfigError, match="depth images without colour"):
            planes_graph(folder, recording, None)
        with pytest.raises(ConfigError, match="no odometry on /other; there is none"):
            planes_graph(folder, recording, "/other")


def test_a_map_without_planes_is_for_other_sensors(tmp_path: Path) -> None:
    save_map(new_mission(Map.empty(), "ab" * 16), tmp_path / "m")

    with open_recording(recorded(tmp_path / "r.mcap", "/depth/image")) as recording:
        assert not is_for_planes(tmp_path / "m", recording)
