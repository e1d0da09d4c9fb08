"""Places recognised by what a LiDAR saw, beside cameras that see the same or nothing."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.operators.features.rows import rows_of
from mapstream.operators.landmarks.create import create_landmarks
from mapstream.operators.places.database import LookConfig
from mapstream.operators.places.loops import VisualLoopsConfig, find_visual_loops
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.rows import take
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.lidar.images.corridors import Drive, mapped, pass_twice, tracked

_NUM = 6  # scans of each pass
_DRIFT = SE3.exp([0, 0, 0.05, 0.5, -0.4, 0.1])
_CAMERA = CameraCalibration(
    width_px=640,
    height_px=480,
    focal_px=np.array([500.0, 500.0]),
    center_px=np.array([320.0, 240.0]),
    distortion_parameters=np.empty(0),
)


@pytest.fixture(scope="module")
def passes() -> Drive:
    return pass_twice(_NUM)


@pytest.fixture(scope="module")
def with_camera(passes: Drive) -> Map:
    """The LiDAR's keypoints, and a camera's that look like no other; the second pass has drifted."""
    poses = [pose if k < _NUM else _DRIFT @ pose for k, pose in enumerate(passes.poses())]
    lidar = tracked(passes, poses)
    for first in (0, _NUM):  # nobody knows how the sensor moved before
        lidar[first] = rows_of(lidar[first], np.empty(0, np.int64))
    seen = [(each, noise(each.stamp_ns)) for each in lidar]
    return create_landmarks(mapped(passes, seen, poses))[0]


def noise(stamp_ns: int) -> ImageFeatures:
    rng = np.random.default_rng(stamp_ns)
    return ImageFeatures(
        stamp_ns=stamp_ns,
        kind="brisk",
        frame="camera",
        keypoints_px=rng.uniform(0, 480, (200, 2)).astype(np.float32),
        descriptors=rng.integers(0, 256, (200, 64), np.uint8),
        track_ids=np.arange(200),  # always the same, so that they become landmarks
        camera=_CAMERA,
    )


@pytest.mark.parametrize("kinds", [("lidar_brisk",), ()])
def test_U5_H8_a_lidar_alone_closes_a_loop_in_a_map_with_cameras(
    passes: Drive, with_camera: Map, kinds: tuple[str, ...]
) -> None:
    """By its kind, or among all kinds; every loop is true, and better than the drift by far."""
    config = VisualLoopsConfig(kinds=kinds, min_gap_s=4.0, look=LookConfig(max_bits=0.2))

    closed, report = find_visual_loops(with_camera, config)

    poses = passes.poses()
    loops = take(closed.edges, closed.edges.kind == "loop")
    assert report.num_edges == len(loops) >= 3
    assert set(report.inliers_by_kind) == {"lidar_brisk"}
    for a, b, T_a_b in zip(loops.vertex_a, loops.vertex_b, loops.T_a_b, strict=True):
        off = SE3(T_a_b).inverse() @ poses[a].inverse() @ poses[b]
        assert float(np.linalg.norm(off.t)) < 0.1


def test_U5_the_camera_alone_closes_none(with_camera: Map) -> None:
    config = VisualLoopsConfig(kinds=("brisk",), min_gap_s=4.0)

    _, report = find_visual_loops(with_camera, config)

    assert report.num_edges == 0
