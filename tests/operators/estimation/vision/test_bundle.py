"""Bundle adjustment: alone, and with all other kinds of measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.estimation.optimize_config import Loss
from mapstream.operators.landmarks.create import create_landmarks
from mapstream.operators.landmarks.locating import LocateConfig
from mapstream.operators.landmarks.views import T_map_sensor_of
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, invert, se3_exp
from tests.operators.estimation.problems import (
    cov,
    disturbed,
    with_edge,
    with_landmark,
    with_relative,
)
from tests.operators.vision_worlds import World, position_errors_m, stereo, with_true_landmarks

GATE = LocateConfig(max_mean_error_sigma=1e3)  # poses of odometry are not those of the images


def rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean()))


def with_depth(world: World, map_: Map, sigma_m: float) -> Map:
    """The map with the 3D point of every keypoint, as a depth camera has it."""
    seen = map_.observations
    T = T_map_sensor_of(world.map(), np.arange(len(seen)))
    p = np.einsum("nji,nj->ni", T[:, :3, :3], world.points[seen.track] - T[:, :3, 3])
    p += world.rng.normal(0, sigma_m, p.shape)
    deep = replace(seen, p_sensor=p.astype(np.float32), sigma_m=np.full(len(seen), sigma_m, np.float32))  # fmt: skip
    return replace(map_, observations=deep)


def started(world: World, *, odometry: bool = True) -> Map:
    """A map as odometry has it, with landmarks from its tracks."""
    map_ = world.with_odometry(world.map()) if odometry else world.map()
    return create_landmarks(map_, GATE)[0]


@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_K3_cameras_and_odometry_together_find_poses_and_points(noise_px: float) -> None:
    """Without noise to a tenth of a millimetre; poses are as good as the pixels."""
    world = World(noise_px=noise_px)
    map_ = started(world)

    result, report = optimize_map(map_)

    assert position_errors_m(world, map_).max() > 0.05
    assert position_errors_m(world, result).max() < (0.01 if noise_px else 1e-4)
    assert report.is_converged
    assert report.kinds["keypoints"].count == (map_.observations.landmark >= 0).sum()
    assert check_map(result) == []


def test_K3_one_problem_holds_observations_and_all_kinds_of_edges() -> None:
    """IMU, keypoints, 3D points, wheel, odometry, loop, absolute, position and a plane, each of which counts."""
    world = World(noise_px=0.3, num_points=60)
    map_ = world.with_odometry(world.with_imu(world.map()))
    num, truth = world.num_vertices, world.poses
    map_ = with_depth(world, map_, 0.02)
    map_ = create_landmarks(map_, GATE)[0]
    flat = np.diag([np.inf, np.inf, 1e-6, 1e-4, 1e-4, np.inf])
    map_ = with_relative(map_, [(k, k + 1) for k in range(num - 1)], truth, flat, kind="wheel")
    map_ = with_relative(map_, [(0, num - 1)], truth, cov(0.002, 0.01), kind="loop")
    wall = truth[0] @ SE3.from_rotation(np.eye(3), [3.0, 1, 1]).matrix
    map_ = with_landmark(map_, "plane", wall)
    for k in range(0, num, 2):
        seen = {"vertex_a": k, "covariance": cov(0.002, 0.01)}
        row = len(map_.landmarks) - 1
        map_ = with_edge(map_, "plane", landmark_a=row, T_a_b=invert(truth[k]) @ wall, **seen)
        map_ = with_edge(map_, "absolute", T_a_b=truth[k], **seen)
        map_ = with_edge(map_, "position", T_a_b=truth[k], **seen)

    result, report = optimize_map(map_)

    assert set(report.kinds) == {"imu", "keypoints", "points", "wheel", "odometry", "loop", "absolute", "position", "plane"}  # fmt: skip
    assert report.error_after < 0.1 * report.error_before
    assert report.is_converged
    assert position_errors_m(world, result).max() < 0.01


def test_K4_images_alone_have_their_scale_from_the_baseline() -> None:
    """Two cameras, no odometry: the first pose is held, everything else is found."""
    world = World()
    map_ = started(world)
    map_ = map_.select(edges=np.zeros(len(map_.edges), bool))

    result, report = optimize_map(map_)

    assert list(report.kinds) == ["keypoints"]
    np.testing.assert_allclose(result.T_map_base(np.array([0])), map_.T_map_base(np.array([0])), atol=1e-9)  # fmt: skip
    assert position_errors_m(world, result).max() < 1e-3


def test_K4_one_camera_alone_has_no_scale_and_odometry_gives_one() -> None:
    """Refused without; with a weak odometry the scale is its own."""
    world = World(cameras={"left": stereo()["left"]})
    map_ = create_landmarks(world.with_odometry(world.map(), 0.02, 0.05, noisy=False), GATE)[0]
    bare = map_.select(edges=np.zeros(len(map_.edges), bool))

    with pytest.raises(EstimationError, match="not determined"):
        optimize_map(bare)
    result, _ = optimize_map(disturbed(map_, world.rng, 0.01, 0.02))

    assert position_errors_m(world, result).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_K7_gross_outliers_hardly_matter(loss: Loss) -> None:
    """A fifth of all keypoints anywhere within 40 px: the error is below 1.5 of that without them."""
    world = World(noise_px=0.5, num_points=200)
    clean = started(world)
    px = clean.observations.keypoint_px.copy()
    wrong = np.flatnonzero(world.rng.random(len(px)) < 0.2)
    px[wrong] += world.rng.uniform(-40, 40, (len(wrong), 2)).astype(np.float32)
    dirty = replace(clean, observations=replace(clean.observations, keypoint_px=px))
    config = OptimizeConfig(losses={"keypoints": loss})

    rms_m = [rms(position_errors_m(world, optimize_map(m, config)[0])) for m in (clean, dirty)]

    assert rms_m[1] < 1.5 * rms_m[0]


def test_K8_false_observations_leave_while_it_solves() -> None:
    """Far from where they should be, or behind a camera: they lose their landmark, and no other does."""
    world = World(noise_px=0.3)
    map_ = started(world)
    px = map_.observations.keypoint_px.copy()
    wrong = np.flatnonzero(map_.observations.landmark >= 0)[::40]
    px[wrong, 0] += 150
    dirty = replace(map_, observations=replace(map_.observations, keypoint_px=px))

    result, report = optimize_map(dirty)

    lost = (map_.observations.landmark >= 0) & (result.observations.landmark < 0)
    assert np.flatnonzero(lost).tolist() == wrong.tolist()
    assert report.num_outliers == len(wrong)
    assert position_errors_m(world, result).max() < 0.01


def test_K6_families_of_observations_take_part_or_not() -> None:
    """Without keypoints nothing but odometry is left; bad landmarks take no part."""
    world = World(noise_px=0.3, num_points=60)
    map_ = with_depth(world, world.with_odometry(world.map()), 0.02)
    map_ = create_landmarks(map_, GATE)[0]
    quality = np.full(len(map_.landmarks), "bad", object)
    bad = replace(map_, landmarks=replace(map_.landmarks, quality=quality))

    kinds = [
        set(optimize_map(m, OptimizeConfig(without=without))[1].kinds)
        for m, without in ((map_, ()), (map_, ("keypoints",)), (map_, ("keypoints", "points")), (bad, ()))
    ]  # fmt: skip

    odometry = {"odometry"}
    assert kinds == [{"keypoints", "points"} | odometry, {"points"} | odometry, odometry, odometry]


def test_D18_E3_depth_gives_one_camera_its_scale() -> None:
    """A depth of 2 cm beside each keypoint; no odometry, one camera."""
    world = World(cameras={"left": stereo()["left"]}, noise_px=0.3)
    map_ = with_depth(world, world.with_odometry(world.map()), 0.02)
    map_ = create_landmarks(map_, GATE)[0]
    map_ = map_.select(edges=np.zeros(len(map_.edges), bool))

    result, report = optimize_map(map_)

    assert set(report.kinds) == {"keypoints", "points"}
    assert position_errors_m(world, result).max() < 0.02


def test_E13_cameras_share_a_graph_with_planes_and_registrations() -> None:
    """Points that lie on a plane which was seen by LiDAR, and steps by ICP; a point with edges of its own."""
    world = World(noise_px=0.3, num_points=80)
    world.points[:, 0] = 6.0
    truth = world.poses
    map_ = create_landmarks(world.with_odometry(world.map()), GATE)[0]
    steps = [(k, k + 1) for k in range(world.num_vertices - 1)]
    map_ = with_relative(map_, steps, truth, cov(0.005, 0.02), kind="registration")
    wall = SE3.from_rotation([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], [6.0, 0, 0]).matrix
    map_ = with_landmark(map_, "plane", wall)
    plane = len(map_.landmarks) - 1
    for k in (0, 10):
        map_ = with_edge(map_, "plane", vertex_a=k, landmark_a=plane, T_a_b=invert(truth[k]) @ wall, covariance=cov(0.002, 0.01))  # fmt: skip
    for row in range(plane):
        map_ = with_edge(map_, "point_on_plane", landmark_a=row, landmark_b=plane, covariance=cov(1, 0.01))  # fmt: skip

    result, report = optimize_map(map_)

    assert set(report.kinds) == {"keypoints", "odometry", "registration", "plane", "point_on_plane"}
    assert position_errors_m(world, result).max() < 0.025
    p = result.T_map_landmark(np.arange(plane))[:, :3, 3]
    assert np.abs(p[:, 0] - 6).max() < 0.02


def test_E6_bad_landmarks_are_left_alone() -> None:
    """They are not moved, and what they saw pulls at nothing."""
    world = World()
    map_ = started(world)
    quality = np.where(np.arange(len(map_.landmarks)) < 10, "bad", "good").astype(object)
    p_base = map_.landmarks.p_base.copy()
    p_base[:10] += 1.0
    map_ = replace(map_, landmarks=replace(map_.landmarks, quality=quality, p_base=p_base))

    result, _ = optimize_map(map_)

    assert (result.landmarks.p_base[:10] == p_base[:10]).all()
    assert position_errors_m(world, result).max() < 2e-4


def test_missions_that_saw_the_same_points_are_one() -> None:
    """Merged landmarks alone place a mission whose base frame was a guess, unless it shall be apart."""
    world = World(num_vertices=12)
    other = World(num_vertices=12, start_s=2.0, mission="6b" * 16)
    map_ = with_true_landmarks(world, other.with_odometry(other.map(world.with_odometry(world.map(), noisy=False)), noisy=False))  # fmt: skip
    frames = map_.missions.T_map_mission.copy()
    frames[1] = se3_exp(np.array([0.02, -0.03, 0.05, 0.1, 0.1, -0.05]))
    map_ = replace(map_, missions=replace(map_.missions, T_map_mission=frames))

    result, _ = optimize_map(map_)
    apart, _ = optimize_map(map_, OptimizeConfig(unanchored="apart"))

    np.testing.assert_allclose(result.missions.T_map_mission[1], np.eye(4), atol=1e-4)
    np.testing.assert_allclose(apart.missions.T_map_mission[1], frames[1], atol=1e-4)


def test_solvers_without_a_place_for_observations_say_so() -> None:
    """And how to go on."""
    with pytest.raises(EstimationError, match="takes no observations; set without"):
        optimize_map(started(World(num_points=40)), OptimizeConfig(solver="dogleg"))
