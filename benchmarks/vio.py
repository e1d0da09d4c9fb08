"""Visual-inertial odometry against real time: a stereo pair at 20 Hz and an IMU at 200 Hz, trackers included.

The pair's tracker runs in a thread and the filter in its own process, so that two cores are used. The recording is a
synthetic world with its truth inside, and the error of the path is shown beside the time.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import anyio
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.graph.load import load_graph
from mapstream.graph.plan import plan
from mapstream.graph.run import run_graph
from mapstream.recordings.decoding import decoder_for
from mapstream.recordings.evaluation import ape, associate
from mapstream.recordings.recording import open_recording
from mapstream.recordings.trajectory_files import read_tum
from mapstream.recordings.worlds.catalogue import simulate
from mapstream.streams.trajectory import Trajectory

DURATION_S = 10.0
SENSORS = """
version: 1
name: vio
operators:
  sensors: {use: mcap, config: {path: IN, topics: {left: /front_left/image, right: /front_right/image, imu: /imu}}}
  left: {use: image_decode, in: {images: sensors.left}}
"""
STEREO = """
  right: {use: image_decode, in: {images: sensors.right}}
  tracks: {use: klt, in: {frames: left.frames, right_frames: right.frames, imu: sensors.imu}}
  n_frames:
    use: n_frames
    in: {left: tracks.features, right: tracks.right_features}
    config: {inputs: [left, right]}
"""
MONO = """
  tracks: {use: klt, in: {frames: left.frames, imu: sensors.imu}}
  n_frames: {use: n_frames, in: {features: tracks.features}}
"""
ODOMETRY = """
  odometry:
    use: visual_inertial_odometry
    in: {n_frames: n_frames.n_frames, imu: sensors.imu}
    config: {imu: {recording: IN}}
  path: {use: trajectory_sink, in: {odometry: odometry.odometry}, config: {path: OUT}}
"""


def _truth(recording: Path) -> Trajectory:
    with open_recording(recording) as source:
        decode = decoder_for(source.topics["/truth"].channel)
        poses: list[Any] = [decode(message) for message in source.messages(topics=["/truth"])]
    return Trajectory(
        stamps_ns=np.array([pose.stamp_ns for pose in poses]),
        poses=np.array([pose.T_odom_base.matrix for pose in poses]),
    )


def _run(tracking: str, recording: Path, folder: Path) -> tuple[float, float]:
    """Return the time that a run takes [s], and the error of its path [m]."""
    graph, path = folder / "vio.yaml", folder / "path.tum"
    text = SENSORS + tracking + ODOMETRY
    if tracking == MONO:
        text = text.replace(", right: /front_right/image", "")
    graph.write_text(text.replace("IN", str(recording)).replace("OUT", str(path)))
    started = time.perf_counter()
    report = anyio.run(run_graph, plan(load_graph(graph)))
    taken_s = time.perf_counter() - started
    if report.exit_code:
        raise RuntimeError(f"the graph did not run to its end: {report}")
    return taken_s, ape(associate(read_tum(path), _truth(recording))).translation.rmse


def run() -> list[Row]:
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording = simulate(
            "w_vi",
            folder / "world.mcap",
            flight={"duration_s": DURATION_S},
            cameras=("front_left", "front_right"),
        )
        for what, tracking in (("one camera", MONO), ("a stereo pair", STEREO)):
            taken_s, error_m = _run(tracking, recording, folder)
            rows.append(
                Row(
                    what=f"visual-inertial odometry, {what} at 20 Hz",
                    ours=f"{taken_s:.1f} s, error {100 * error_m:.1f} cm",
                    other=f"recording {DURATION_S:.0f} s",
                    ratio=taken_s / DURATION_S,
                    bar="at most 1",
                )
            )
    return rows


if __name__ == "__main__":
    print(markdown(run()))
