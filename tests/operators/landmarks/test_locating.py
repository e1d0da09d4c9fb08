"""Landmarks made from tracks: where they are, which are made, and where they go when poses move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.landmarks.create import create_landmarks, retriangulate
from mapstream.operators.landmarks.locating import LocateConfig
from mapstream.operators.landmarks.motion import Motion, moments
from mapstream.operators.landmarks.views import reprojection_errors_px
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.features import add_features
from mapstream.recordings.maps.tables import Observations
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3, invert, se3_exp, se3_log
from mapstream.streams.messages.vision import ImageFeatures
from tests.operators.vision_worlds import World, landmark_errors_m, poses_at, stereo

FISHEYE = CameraCalibration(
    model="unified", xi=0.9, width_px=640, height_px=480, focal_px=np.array([500.0, 505.0]),
    center_px=np.array([318.0, 241.0]), distortion="equidistant",
    distortion_parameters=np.array([-0.01, 0.004, 0.0, 0.0]),
)  # fmt: skip


@pytest.mark.parametrize("camera", [None, FISHEYE])
def test_E2_exact_tracks_give_points_within_a_millimetre(camera: CameraCalibration | None) -> None:
    """Over both cameras, whatever their model."""
    world = World(cameras=stereo() if camera is None else stereo(camera), num_vertices=12)

    map_, report = create_landmarks(world.map())

    assert report.num_found > 80
    assert landmark_errors_m(world, map_).max() < 1e-3
    assert check_map(map_)[1:] == []  # but that nothing links the vertices


def test_E2_one_pixel_of_noise_leaves_three_centimetres() -> None:
    """Median, points being 4 to 8 m away."""
    world = World(noise_px=1.0)

    map_, _ = create_landmarks(world.map())

    assert np.median(landmark_errors_m(world, map_)) < 0.03


def test_E2_false_matches_in_a_track_do_not_pull() -> None:
    """One keypoint in ten is anywhere in the image."""
    world = World(noise_px=0.5)
    map_ = world.map()
    px = map_.observations.keypoint_px.copy()
    wrong = world.rng.random(len(px)) < 0.1
    px[wrong] = world.rng.uniform(0, 480, (int(wrong.sum()), 2))
    config = LocateConfig(max_mean_error_sigma=50)

    found, _ = create_landmarks(replace(map_, observations=replace(map_.observations, keypoint_px=px)), config)  # fmt: skip

    assert np.median(landmark_errors_m(world, found)) < 0.03


def test_E2_rays_that_hardly_meet_are_counted_and_make_no_landmark() -> None:
    """Seen twice from 10 cm apart, points in 4 m and more have less than 5 degrees."""
    world = World(cameras=stereo(baseline_m=0.1), num_vertices=1)

    map_, report = create_landmarks(world.map())

    assert len(map_.landmarks) == 0
    assert report.num_found == 0
    assert report.not_found["too little parallax"] > 50


def test_E9_exactly_the_tracks_without_a_landmark_that_are_eligible_get_one() -> None:
    """By mission, kind and track, over all cameras; a second call makes none."""
    world, other = (
        World(num_points=60),
        World(num_points=60, seed=1, mission="6b" * 16, kind="sift"),
    )
    map_ = other.map(world.map())
    seen = map_.observations
    keys = {(m, k, t) for m, k, t in zip(map_.vertices.mission[seen.vertex], seen.kind, seen.track, strict=True)}  # fmt: skip

    made, report = create_landmarks(map_)
    again, second = create_landmarks(made)

    assert report.num_found + sum(report.not_found.values()) == len(keys)
    assert len(made.landmarks) == report.num_found > 80
    found = made.observations.landmark
    groups = {(m, k, t, row) for m, k, t, row in zip(map_.vertices.mission[seen.vertex], seen.kind, seen.track, found, strict=True)}  # fmt: skip
    assert len(groups) == len(keys)  # all observations of a track have the same
    assert second.num_found == 0
    assert again.digest() == made.digest()


def test_E8_landmarks_follow_poses_that_moved() -> None:
    """A change of all poses: retriangulated points are those that a fresh map has."""
    world = World(num_points=60, noise_px=0.5)
    map_, _ = create_landmarks(world.map())
    moves = se3_exp(world.rng.normal(0, 0.002, (world.num_vertices, 6)))
    poses = map_.vertices.T_mission_base @ moves
    moved = replace(map_, vertices=replace(map_.vertices, T_mission_base=poses))
    free = replace(moved.observations, landmark=np.full(len(moved.observations), -1))
    bare = replace(moved, observations=free).select(landmarks=np.zeros(len(map_.landmarks), bool))

    result, report = retriangulate(moved)
    fresh, _ = create_landmarks(bare)

    p, expected = (m.T_map_landmark(np.arange(len(m.landmarks)))[:, :3, 3] for m in (result, fresh))
    assert report.num_found == len(map_.landmarks) == len(fresh.landmarks)
    np.testing.assert_allclose(p, expected, atol=1e-6)


def test_E3_E16_points_of_a_sweep_are_averaged_where_the_sensor_was() -> None:
    """A sensor turning at 90 degrees a second sees points up to 0.1 s after its vertex."""
    world = World(num_points=40, num_vertices=12, step_s=0.1, cameras={})
    world.times_s = world.times_s  # the motion below turns the world's poses
    turning = np.array([se3_exp([0, 0, np.pi / 2 * t, 0, 0, 0]) for t in world.times_s])
    offsets = np.tile(np.linspace(0, 0.1, world.num_points), (world.num_vertices - 1, 1))
    rows = np.repeat(np.arange(world.num_vertices - 1), world.num_points)
    at = np.array([se3_exp([0, 0, np.pi / 2 * (world.times_s[v] + dt), 0, 0, 0]) for v, dt in zip(rows, offsets.ravel(), strict=True)])  # fmt: skip
    track = np.tile(np.arange(world.num_points), world.num_vertices - 1)
    seen = Observations(
        vertex=rows,
        landmark=np.full(len(rows), -1),
        sensor=np.full(len(rows), "lidar", object),
        kind=np.full(len(rows), "corner", object),
        p_sensor=np.einsum("nji,nj->ni", at[:, :3, :3], world.points[track]),
        offset_ns=np.rint(offsets.ravel() * 1e9).astype(np.int64),
        sigma=np.full(len(rows), 0.02),
        track=track,
    )
    map_ = world.map()
    map_ = replace(map_, observations=seen, vertices=replace(map_.vertices, T_mission_base=turning))

    made, _ = create_landmarks(map_)
    ignorant, _ = create_landmarks(replace(map_, observations=replace(seen, offset_ns=np.zeros(len(rows), np.int64))))  # fmt: skip

    assert landmark_errors_m(world, made).max() < 0.05
    assert np.median(landmark_errors_m(world, ignorant)) > 0.15


def test_E16_no_offset_gives_the_vertex_and_others_the_motion_between() -> None:
    """Cubic between vertices; their poses themselves at no offset, to the last bit."""
    world = World(num_vertices=10)
    motion = Motion.of(world.with_imu(world.with_odometry(world.map(), noisy=False)))
    vertices = np.arange(1, 9).repeat(5)
    offsets_ns = np.tile(np.array([-100, -20, 0, 20, 110]) * 1_000_000, 8)

    near = moments(motion, vertices, offsets_ns)

    truth = invert(world.poses[vertices]) @ poses_at(world.times_s[vertices] + offsets_ns / 1e9)
    assert (near.T_vertex_moment[offsets_ns == 0] == np.eye(4)).all()
    assert np.abs(se3_log(invert(truth) @ near.T_vertex_moment)).max() < 2e-4
    step = poses_at(world.times_s[vertices] + offsets_ns / 1e9 + 1e-5)
    twist = se3_log(invert(world.poses[vertices] @ truth) @ step) / 1e-5
    assert np.abs(near.twists - twist).max() < 0.01


def test_A22_rows_of_a_rolling_shutter_are_seen_one_after_another() -> None:
    """With 20 ms readout, points are right if each row has its own pose, and 5 times worse if not."""
    rolling = replace(World().cameras["left"].calibration, line_delay_ns=41_667)
    world = World(cameras=stereo(rolling))
    map_ = world.with_imu(world.with_odometry(world.map(), noisy=False))
    known, _ = create_landmarks(map_)
    texts = map_.missions.sensors.copy()
    texts[0] = texts[0].replace("41667", "0")
    ignorant = replace(known, missions=replace(map_.missions, sensors=texts))

    rows = np.flatnonzero(known.observations.landmark >= 0)

    assert np.nanmedian(reprojection_errors_px(known, rows)) < 0.02
    assert np.nanmedian(reprojection_errors_px(ignorant, rows)) > 0.3


def test_E3_points_of_a_sensor_that_is_no_camera_lie_where_it_sits() -> None:
    """Its place comes with its features, and stays in the map."""
    world = World(num_points=10, num_vertices=3, cameras={})
    place = SE3.exp([0.1, -0.2, 0.3, 0.5, 0.1, 0.2])
    T = world.poses @ place.matrix
    p = np.einsum("nji,nkj->nki", T[:, :3, :3], world.points[None] - T[:, None, :3, 3])
    map_ = world.map()
    seen = [
        (row, int(stamp_ns), ImageFeatures(
            stamp_ns=int(stamp_ns), kind="corner", frame="lidar", keypoints_px=np.zeros((10, 2), np.float32),
            track_ids=np.arange(10), points_m=p[row].astype(np.float32), T_base_sensor=place,
        ))
        for row, stamp_ns in enumerate(world.stamps_ns)
    ]  # fmt: skip

    made, report = create_landmarks(add_features(map_, 0, seen))

    assert report.num_found == 10
    assert landmark_errors_m(world, made).max() < 1e-5
