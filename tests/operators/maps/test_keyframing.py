"""Fewer vertices: which stay and why, and that what was measured between them is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.estimation.batch import OptimizeConfig, optimize_map
from mapstream.operators.landmarks.create import create_landmarks
from mapstream.operators.maps.composing import Motion, composed
from mapstream.operators.maps.keyframing import KeyframingConfig, keyframe
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Observations
from mapstream.streams.geometry import SE3, invert, se3_exp
from tests.operators.estimation.problems import cov, with_edge, with_mission, with_relative
from tests.operators.estimation.vision.test_bundle import GATE, rms
from tests.operators.vision_worlds import World, poses_at, position_errors_m

STILL = KeyframingConfig(every=1000, min_distance_m=1e6, min_angle_rad=10)


def driven(num: int = 21, step: tuple[float, ...] = (0, 0, 0, 0.1, 0, 0)) -> Map:
    poses = np.array([se3_exp(np.array(step) * k) for k in range(num)])
    map_ = with_mission(poses)
    return with_relative(map_, [(k, k + 1) for k in range(num - 1)], poses, cov(0.01, 0.02))


def kept(map_: Map, config: KeyframingConfig) -> tuple[list[int], dict[str, int]]:
    left, report = keyframe(map_, config)
    assert check_map(left) == []
    rows = np.searchsorted(map_.vertices.stamp_ns, left.vertices.stamp_ns)
    return rows.tolist(), report.reasons


@pytest.mark.parametrize(
    ("step", "config", "expected", "reason"),
    [
        ((0, 0, 0, 0.1, 0, 0), STILL, [0, 20], "first or last"),
        ((0, 0, 0, 0.1, 0, 0), STILL.model_copy(update={"every": 7}), [0, 7, 14, 20], "every"),
        ((0, 0, 0, 0.1, 0, 0), STILL.model_copy(update={"min_distance_m": 0.75}), [0, 8, 16, 20], "distance"),
        ((0, 0, np.deg2rad(5.0), 0, 0, 0), STILL.model_copy(update={"min_angle_rad": np.deg2rad(19.9)}), [0, 4, 8, 12, 16, 20], "angle"),
    ],
)  # fmt: skip
def test_M7_vertices_stay_by_place(
    step: tuple[float, ...], config: KeyframingConfig, expected: list[int], reason: str
) -> None:
    """The first and the last, every so many, after so many metres and degrees."""
    rows, reasons = kept(driven(step=step), config)

    assert rows == expected
    assert reason in reasons


def test_M7_vertices_with_measurements_of_their_own_stay() -> None:
    """Absolute ones, and both ends of loops; unless that is not wanted."""
    map_ = driven()
    map_ = with_edge(map_, "absolute", vertex_a=5, T_a_b=np.eye(4), covariance=cov(0.1, 0.1))
    poses = map_.vertices.T_mission_base
    map_ = with_relative(map_, [(9, 13)], poses, cov(0.1, 0.1), kind="loop")

    rows, reasons = kept(map_, STILL)
    none, _ = kept(map_, STILL.model_copy(update={"keep_absolute": False, "keep_loops": False}))

    assert rows == [0, 5, 9, 13, 20]
    assert reasons == {"first or last": 2, "absolute measurement": 1, "loop": 2}
    assert none == [0, 20]


def test_M7_vertices_that_see_other_points_stay() -> None:
    """A vertex sees 30 points, of which 5 go with each step: after three there are 15 in common."""
    map_ = driven()
    vertex = np.repeat(np.arange(21), 30)
    track = np.concatenate([np.arange(5 * k, 5 * k + 30) for k in range(21)])
    seen = Observations(
        vertex=vertex,
        landmark=np.full(len(track), -1),
        sensor=np.full(len(track), "left", object),
        kind=np.full(len(track), "brisk", object),
        keypoint_px=np.ones((len(track), 2), np.float32),
        track=track,
    )

    rows, reasons = kept(replace(map_, observations=seen), STILL)

    assert rows == [0, 3, 6, 9, 12, 15, 18, 20]
    assert reasons["few common points"] == 6


def test_M7_edges_between_are_the_composition() -> None:
    """Of odometry with its covariance, and of IMU samples."""
    world = World(cameras={})
    map_ = world.with_odometry(world.with_imu(world.map()))
    odometry = map_.edges_of("odometry")[:7]

    left, report = keyframe(map_, STILL.model_copy(update={"every": 7}))

    motion = composed(Motion(map_.edges.T_a_b_of(r), map_.edges.covariance[r]) for r in odometry)
    merged = left.edges_of("odometry")[0]
    np.testing.assert_allclose(left.edges.T_a_b[merged], motion.T.matrix, atol=1e-12)
    np.testing.assert_allclose(left.edges.covariance[merged], motion.covariance, atol=1e-15)
    assert report.num_merged_edges == 6
    own = left.imu.stamp_ns[left.imu.edge == left.edges_of("imu")[0]]
    assert (np.diff(own) > 0).all()
    assert own[0] == left.vertices.stamp_ns[0]
    assert own[-1] == left.vertices.stamp_ns[1]
    truth = invert(poses_at(world.times_s[:1])) @ poses_at(world.times_s[7:8])
    assert np.linalg.norm(SE3(invert(truth[0]) @ motion.T.matrix).t) < 0.1


def test_M7_the_solution_is_as_good_with_fewer_vertices() -> None:
    """Bundle adjustment with IMU and cameras, before and after: positions differ by less than 5 mm."""
    world = World(noise_px=0.3, num_vertices=40, step_s=0.1)
    map_ = create_landmarks(world.with_odometry(world.with_imu(world.map()), 0.002, 0.005), GATE)[0]

    sparse, report = keyframe(map_)
    whole, fewer = (optimize_map(m, OptimizeConfig())[0] for m in (map_, sparse))

    stays = np.isin(whole.vertices.stamp_ns, fewer.vertices.stamp_ns)
    errors_m = position_errors_m(world, whole)[stays]
    p = fewer.T_map_base(np.arange(len(fewer.vertices)))[:, :3, 3]
    errors_fewer_m = np.linalg.norm(p - world.poses[stays, :3, 3], axis=1)
    assert report.num_kept < 20
    assert abs(rms(errors_m) - rms(errors_fewer_m)) < 0.005
    assert check_map(fewer) == []
