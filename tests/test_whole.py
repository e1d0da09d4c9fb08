"""From a recording to a map: the presets, whole, and the same map every time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest

from mapstream.graph.catalogue import Catalogue
from mapstream.graph.load import load_graph
from mapstream.graph.plan import Plan, plan
from mapstream.graph.report import RunReport
from mapstream.graph.run import run_graph
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.maps import Map, check_map, load_map
from mapstream.recordings.recording import open_recording
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert
from mapstream.streams.replay_clock import ReplayClock
from mapstream.streams.trajectory import Trajectory
from tests.data import shared

pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Drive:
    path: Path
    truth: Trajectory


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    """A short W-LID: once round a ring of 40 m, and a little further."""
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    lidar = {"beams": 24, "columns": 256, "rate_hz": 10.0}
    simulate("w_lid", path, seed=3, length_m=40, overlap_fraction=0.2, lidar=lidar)
    stamps, poses = [], []
    with open_recording(path) as recording:
        for raw in recording.messages(topics=["/truth"]):
            message: Any = decoder_for(raw.channel)(raw)
            stamps.append(message.stamp_ns)
            poses.append(message.T_odom_base.matrix)
    return Drive(path, Trajectory(stamps_ns=np.array(stamps), poses=np.array(poses)))


def planned(preset: str, recording: Path, folder: Path, **params: str) -> Plan:
    values = {"recording": str(recording), "map": str(folder)} | params
    return plan(load_graph(preset, params=values), Catalogue())


def run(a_plan: Plan, rate: float | None = None) -> RunReport:
    report = anyio.run(lambda: run_graph(a_plan, clock=ReplayClock(rate)))
    assert report.status == "complete", report
    return report


def errors_m(map_: Map, truth: Trajectory) -> FloatArray:
    """Return the position error of every vertex, both trajectories beginning at the same place."""
    rows = map_.vertices_of(0)
    stamps = map_.vertices.stamp_ns[rows]
    inside = (stamps >= truth.stamps_ns[0]) & (stamps <= truth.stamps_ns[-1])
    estimated, true = map_.vertices.T_mission_base[rows[inside]], truth.at(stamps[inside])
    offset = (invert(estimated[0]) @ estimated - invert(true[0]) @ true)[:, :3, 3]
    return np.asarray(np.linalg.norm(offset, axis=1))


def contents(folder: Path) -> dict[str, bytes]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != ".mapstream.lock")
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


@pytest.mark.parametrize("preset", ["lidar", "lidar_gicp"])
def test_I7_the_presets_close_the_loop(preset: str, drive: Drive, tmp_path: Path) -> None:
    run(planned(preset, drive.path, tmp_path / "map"))

    map_ = load_map(tmp_path / "map")
    assert not check_map(map_, tmp_path / "map")
    assert len(map_.edges_of("loop")) > 0
    assert errors_m(map_, drive.truth)[-1] < 0.20
    assert (tmp_path / "map.tum").read_text().count("\n") >= len(map_.vertices)


def test_B14_the_map_is_the_same_bytes_for_any_placement_worker_count_and_rate(
    drive: Drive, tmp_path: Path
) -> None:
    def variant(name: str, changes: dict[str, Any], rate: float | None = None) -> dict[str, bytes]:
        base = planned("lidar", drive.path, tmp_path / name)
        nodes = {n: replace(node, **changes) for n, node in base.nodes.items()}
        run(replace(base, nodes=nodes), rate)
        return contents(tmp_path / name)

    expected = variant("as_planned", {})

    assert variant("again", {}) == expected
    assert variant("inline", {"placement": "inline"}) == expected
    assert variant("threads", {"placement": "thread", "workers": 4}) == expected
    assert variant("at_five_times", {}, rate=5.0) == expected


def test_the_real_recording_with_camera_and_lidar_becomes_a_map(tmp_path: Path) -> None:
    recording = next(shared("kitti_camera_lidar").glob("*.mcap"))

    run(planned("lidar", recording, tmp_path / "map", scans_topic="/velodyne_points"))

    map_ = load_map(tmp_path / "map")
    assert not check_map(map_, tmp_path / "map")
    assert len(map_.vertices) >= 4
