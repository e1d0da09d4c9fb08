"""Visual-inertial odometry on real recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mapstream.graph.load import load_graph
from mapstream.graph.plan import plan
from mapstream.graph.run import run_graph
from mapstream.recordings.datasets.catalogue import convert
from mapstream.recordings.evaluation import ape, associate
from mapstream.recordings.trajectory_files import read_tum
from mapstream.streams.geometry import rotation_from_quat_xyzw
from mapstream.streams.trajectory import Trajectory
from tests.data import shared

pytestmark = pytest.mark.anyio

TRACKS = """
version: 1
name: tracks
operators:
  sensors: {use: mcap, config: {path: RECORDING, topics: {features: /cam0/features, imu: /imu}}}
  n_frames: {use: n_frames, in: {features: sensors.features}}
  odometry:
    use: visual_inertial_odometry
    in: {n_frames: n_frames.n_frames, imu: sensors.imu}
    config: {imu: {recording: RECORDING}}
    run: inline
  path: {use: trajectory_sink, in: {odometry: odometry.odometry}, config: {path: OUT}}
"""


async def run(graph: str, recording: Path, folder: Path) -> Trajectory:
    """Return what the graph wrote."""
    file, out = folder / "graph.yaml", folder / "path.tum"
    file.write_text(graph.replace("RECORDING", str(recording)).replace("OUT", str(out)))
    report = await run_graph(plan(load_graph(file)))
    assert report.exit_code == 0, report
    return read_tum(out)


def open_vins() -> Trajectory:
    """Return another estimator's poses of EuRoC V1_01."""
    file = shared("euroc_v101_stereo_imu") / "gt_V1_01_easy_openvins.csv"
    rows = np.genfromtxt(file, delimiter=",")
    stamps = np.genfromtxt(file, delimiter=",", usecols=[0], dtype=np.int64)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = rows[:, 1:4]
    poses[:, :3, :3] = rotation_from_quat_xyzw(rows[:, [5, 6, 7, 4]])
    return Trajectory(stamps_ns=stamps, poses=poses)


@pytest.mark.slow
async def test_C9_euroc_v1_01_for_30_s(tmp_path: Path) -> None:
    """Tracks of one camera, from the installed gtsam."""
    reference = open_vins()
    recording = convert("eqvio", tmp_path / "tracks.mcap").path

    found = await run(TRACKS, recording, tmp_path)

    assert len(found) == 601
    errors = ape(associate(found, reference))
    assert errors.translation.rmse < 0.05
