"""Visual-inertial, stereo and RGB-D odometry on real recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.graph.load import load_graph
from mapstream.graph.plan import plan
from mapstream.graph.run import run_graph
from mapstream.recordings.datasets.catalogue import convert
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.evaluation import align, ape, associate
from mapstream.recordings.pose_pairs import PosePairs
from mapstream.recordings.recording import open_recording
from mapstream.recordings.trajectory_files import read_kitti, read_tum
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.streams.geometry import invert, rotation_from_quat_xyzw
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
PAIR = """
version: 1
name: pair
operators:
  sensors: {use: mcap, config: {path: RECORDING, topics: {left: /cam0/image, right: /cam1/image}}}
  left: {use: image_decode, in: {images: sensors.left}}
  right: {use: image_decode, in: {images: sensors.right}}
  tracks: {use: klt, in: {frames: left.frames, right_frames: right.frames}, config: {max_tracks: 500}}
  n_frames:
    use: n_frames
    in: {left: tracks.features, right: tracks.right_features}
    config: {inputs: [left, right]}
  odometry: {use: visual_odometry, in: {n_frames: n_frames.n_frames}, run: inline}
  path: {use: trajectory_sink, in: {odometry: odometry.odometry}, config: {path: OUT}}
"""
DEPTH = """
version: 1
name: depth
operators:
  sensors: {use: mcap, config: {path: RECORDING, topics: {color: /color/image, depth: /depth/image}}}
  color: {use: image_decode, in: {images: sensors.color}}
  depth: {use: image_decode, in: {images: sensors.depth}, config: {mode: depth}}
  registered: {use: depth_registration, in: {depth: depth.frames, frames: color.frames}}
  tracks:
    use: klt
    in: {frames: color.frames}
    config: {max_tracks: 250}
  points: {use: keypoint_depth, in: {features: tracks.features, depth: registered.depth}}
  n_frames: {use: n_frames, in: {features: points.features}}
  odometry: {use: visual_odometry, in: {n_frames: n_frames.n_frames}, run: inline}
  path: {use: trajectory_sink, in: {odometry: odometry.odometry}, config: {path: OUT}}
"""
DENSE = """
version: 1
name: dense
operators:
  sensors:
    use: mcap
    config: {path: RECORDING, topics: {color: /color/image, depth: /depth/image}, end_s: 1.99}
  color: {use: image_decode, in: {images: sensors.color}}
  depth: {use: image_decode, in: {images: sensors.depth}, config: {mode: depth}}
  registered: {use: depth_registration, in: {depth: depth.frames, frames: color.frames}}
  odometry:
    use: dense_visual_odometry
    in: {frames: color.frames, depth: registered.depth}
    config: {width_px: 160}
    run: inline
  path: {use: trajectory_sink, in: {odometry: odometry.odometry}, config: {path: OUT}}
"""
MONO = """
version: 1
name: mono
operators:
  sensors: {use: mcap, config: {path: RECORDING, topics: {images: /front_left/image, imu: /imu}}}
  frames: {use: image_decode, in: {images: sensors.images}}
  tracks: {use: klt, in: {frames: frames.frames, imu: sensors.imu}, config: {min_distance_px: 10}}
  n_frames: {use: n_frames, in: {features: tracks.features}}
  odometry:
    use: visual_inertial_odometry
    in: {n_frames: n_frames.n_frames, imu: sensors.imu}
    config: {imu: {recording: RECORDING}}
    run: inline
  path: {use: trajectory_sink, in: {odometry: odometry.odometry}, config: {path: OUT}}
"""
STANDING = """
version: 1
name: standing
operators:
  sensors:
    use: mcap
    config: {path: RECORDING, topics: {left: /cam0/image, right: /cam1/image, imu: /imu}}
  left: {use: image_decode, in: {images: sensors.left}}
  right: {use: image_decode, in: {images: sensors.right}}
  tracks:
    use: klt
    in: {frames: left.frames, right_frames: right.frames, imu: sensors.imu}
  n_frames:
    use: n_frames
    in: {left: tracks.features, right: tracks.right_features}
    config: {inputs: [left, right]}
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


@pytest.mark.slow
async def test_A2_C9_one_camera_and_an_imu_fly_through_w_vi(tmp_path: Path) -> None:
    recording = simulate(
        "w_vi",
        tmp_path / "world.mcap",
        cameras=["front_left"],
        camera={"width_px": 320, "height_px": 240, "rate_hz": 10.0},
        flight={"duration_s": 6.0, "start": "moving"},
        texel_m=0.01,
    )
    with open_recording(recording) as source:
        decode = decoder_for(source.topics["/truth"].channel)
        truth: list[Any] = [decode(message) for message in source.messages(topics=["/truth"])]
    reference = Trajectory(
        stamps_ns=np.array([pose.stamp_ns for pose in truth]),
        poses=np.array([pose.T_odom_base.matrix for pose in truth]),
    )

    found = await run(MONO, recording, tmp_path)

    pairs = associate(found, reference)
    assert len(pairs) > 30
    assert ape(pairs).translation.rmse < 0.10
    assert align(pairs, "sim3").scale == pytest.approx(1, abs=0.02)


@pytest.mark.slow
async def test_a_real_drone_that_stands_does_not_drift(tmp_path: Path) -> None:
    recording = convert(f"euroc:{shared('euroc_v101_stereo_imu')}", tmp_path / "in.mcap").path

    found = await run(STANDING, recording, tmp_path)

    assert len(found) == 20
    path = found.poses[:, :3, 3]
    assert np.linalg.norm(path - path[0], axis=1).max() < 0.01


@pytest.mark.slow
async def test_a_real_street_in_stereo(tmp_path: Path) -> None:
    folder = shared("kitti_stereo")
    recording = convert(f"kitti:{folder}", tmp_path / "in.mcap").path
    reference = read_kitti(folder / "poses.txt").poses[:25]

    found = (await run(PAIR, recording, tmp_path)).poses

    assert len(found) == 25
    true, drifted = (invert(poses[0]) @ poses[-1] for poses in (reference, found))
    length_m = np.linalg.norm(np.diff(reference[:, :3, 3], axis=0), axis=1).sum()
    drift = np.linalg.norm(true[:3, 3] - drifted[:3, 3]) / length_m
    assert drift < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("graph", "count", "bar_m"), [(DEPTH, 150, 0.06), (DENSE, 60, 0.01)])
async def test_C8_a_real_kitchen_in_colour_and_depth(
    tmp_path: Path, graph: str, count: int, bar_m: float
) -> None:
    """Whole images are 0.014 m off over all 150; features with PnP 0.107 m, over 600."""
    folder = shared("redkitchen_rgbd")
    recording = convert(f"7scenes:{folder}", tmp_path / "in.mcap").path
    poses = [np.loadtxt(folder / f"frame-{k:06d}.pose.txt") for k in range(count)]

    found = await run(graph, recording, tmp_path)

    assert len(found) == count
    pairs = PosePairs(stamps_ns=found.stamps_ns, estimate=found.poses, reference=np.array(poses))
    assert ape(pairs).translation.rmse < bar_m
