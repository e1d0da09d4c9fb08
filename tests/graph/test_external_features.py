"""Three kinds of features that nobody here knows enter a graph by its file, and become landmarks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapstream.recordings.attached_rig import attach_rig
from mapstream.recordings.maps import check_map, load_map
from mapstream.recordings.mcap_writer import McapWriter
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.vision import ImageFeatures
from mapstream.streams.rig import Extrinsics, Rig
from mapstream.streams.sensors import CameraSensor, Sensor
from tests.graph.terminal import Terminal

_OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
_PLACES = {
    "cam": SE3.from_rotation(_OPTICAL, [0.1, 0.05, 0.0]),
    "lidar": SE3.from_rotation(np.eye(3), [0.0, 0.0, 0.3]),
}
_CAMERA = CameraCalibration(
    frame="cam",
    width_px=640,
    height_px=480,
    focal_px=np.full(2, 420.0),
    center_px=np.array([320.0, 240.0]),
    distortion_parameters=np.empty(0),
)
_GRAPH = """version: 1
name: theirs
params: {recording: {type: path}, map: {type: path}}
operators:
  sensors:
    use: mcap
    config:
      path: $recording
      topics:
        odometry: /odometry
        binary: {topic: /their/binary, type: ImageFeatures}
        numbers: {topic: /their/numbers, type: ImageFeatures}
        points: {topic: /their/points, type: ImageFeatures}
  binary: {use: external_features, in: {features: sensors.binary}}
  numbers: {use: external_features, in: {features: sensors.numbers}}
  points: {use: external_features, in: {features: sensors.points}}
  tracks: {use: feature_tracker, in: {features: numbers.features}}
  seen:
    use: n_frames
    in: {binary: binary.features, numbers: tracks.features, points: points.features}
    config: {inputs: [binary, numbers, points]}
  trajectory:
    use: trajectory
    in: {odometry: sensors.odometry, n_frames: seen.n_frames}
    config: {sources: {odometry: {kind: odometry}}, n_frames: true, period_s: null, distance_m: 0.05}
  optimizer: {use: optimizer, in: {submaps: trajectory.submaps}}
  landmarks: {use: map_steps, in: {maps: optimizer.maps}, config: {steps: [{tool: create_landmarks}]}}
  store: {use: map_store, in: {maps: landmarks.maps, submaps: trajectory.submaps}, config: {path: $map}}
"""


def _rig() -> Rig:
    camera = CameraSensor(id="1" * 32, frame="cam", calibration=_CAMERA)
    lidar = Sensor(id="2" * 32, kind="lidar", frame="lidar")
    body = Sensor(id="3" * 32, kind="odometry", frame="body")
    sensors = {"cam": camera, "lidar": lidar, "body": body}
    places = _PLACES | {"body": SE3.identity()}
    return Rig(
        list(sensors.values()),
        [
            Extrinsics(sensor_id=s.id, base_sensor_id=body.id, T_base_sensor=places[name])
            for name, s in sensors.items()
        ],
    )


def _seen_from(T_world_base: SE3, frame: str, points: np.ndarray) -> np.ndarray:
    T_sensor_world = (T_world_base @ _PLACES[frame]).inverse()
    return np.asarray(points @ T_sensor_world.R.T + T_sensor_world.t)


@pytest.fixture
def theirs(tmp_path: Path) -> tuple[Path, np.ndarray]:
    """Return two seconds of a drive sideways before points, and the points."""
    rng = np.random.default_rng(0)
    points = rng.uniform([5, -3, -2], [8, 3, 2], (60, 3))
    bits = rng.integers(0, 256, (60, 32), np.uint8)
    numbers = rng.normal(size=(60, 128)).astype(np.float32)
    path = tmp_path / "theirs.mcap"
    with McapWriter(path) as writer:
        attach_rig(writer, _rig())
        for step in range(20):
            T = SE3.exp([0, 0.01 * step, 0.005 * step, 0.01 * step, 0.06 * step, 0])
            common: dict[str, Any] = {"stamp_ns": 10**9 + step * 100_000_000}
            writer.write("/odometry", Odometry(**common, T_odom_base=T))
            px, is_seen = project(_CAMERA, _seen_from(T, "cam", points))
            rows = np.flatnonzero(is_seen & ((px > 0) & (px < [640, 480])).all(axis=1))
            at = (px[rows] + rng.normal(0, 0.2, (len(rows), 2))).astype(np.float32)
            order = rng.permutation(len(rows))
            binary = ImageFeatures(
                **common, kind="bits", frame="cam", keypoints_px=at,
                descriptors=bits[rows], track_ids=rows,
            )  # fmt: skip
            floats = ImageFeatures(
                **common, kind="numbers", frame="cam", keypoints_px=at[order],
                descriptors=numbers[rows[order]],
            )  # fmt: skip
            measured = _seen_from(T, "lidar", points) + rng.normal(0, 0.02, points.shape)
            spatial = ImageFeatures(
                **common, kind="spatial", frame="lidar", descriptors=numbers[:, :32],
                keypoints_px=np.zeros((60, 2), np.float32), track_ids=np.arange(60),
                points_m=measured.astype(np.float32), point_sigmas_m=np.full(60, 0.02, np.float32),
            )  # fmt: skip
            for topic, message in (("binary", binary), ("numbers", floats), ("points", spatial)):
                writer.write(f"/their/{topic}", message)
    return path, points


def test_A14_three_external_kinds_enter_by_the_graph_file_and_make_landmarks(
    theirs: tuple[Path, np.ndarray], mapstream: Terminal, tmp_path: Path
) -> None:
    recording, points = theirs
    graph, folder = tmp_path / "graph.yaml", tmp_path / "map"
    graph.write_text(_GRAPH)

    done = mapstream("run", graph, recording, "--map", folder)

    assert done.code == 0, done.out + done.err
    map_ = load_map(folder)
    assert check_map(map_, folder) == []
    places = map_.T_map_landmark(np.arange(len(map_.landmarks)))[:, :3, 3]
    for kind, least in (("bits", 40), ("numbers", 40), ("spatial", 55)):
        found = places[map_.landmarks.kind == kind]
        distances = np.linalg.norm(found[:, None] - points, axis=2).min(axis=1)
        assert len(found) > least, kind
        assert np.median(distances) < 0.1, kind
