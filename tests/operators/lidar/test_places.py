"""Places of a LiDAR: recognised from anywhere, never in another building, and missions that find each other."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.backend.optimizer import Optimizer, OptimizerConfig
from mapstream.operators.estimation.batch import optimize_map
from mapstream.operators.landmarks.create import create_landmarks
from mapstream.operators.lidar.places.birds_eye import levelling
from mapstream.operators.lidar.places.find_places import SOURCE, FindPlacesConfig, find_places
from mapstream.operators.lidar.places.lidar_places import LidarPlaces, LidarPlacesConfig
from mapstream.operators.lidar.places.place_matcher import PlaceMatcher, PlaceMatchingConfig
from mapstream.operators.lidar.places.planar_motion import planar_motion
from mapstream.operators.lidar.places.recognizers import make_recognizer
from mapstream.operators.testing import run_operator
from mapstream.recordings.maps.check import check_map
from mapstream.streams.errors import ConfigError, EstimationError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import PointCloud
from tests.data import shared
from tests.operators.lidar.drives import (
    MISSION,
    OTHER_MISSION,
    both,
    circle,
    rms_m,
    stored,
    submap_of,
    worst_edge_m,
)
from tests.operators.places import made_maps, scenes
from tests.operators.scenes import room, seen_from

HALL = room(5, num_points=14_000, boxes=16)
OTHER_HALL = room(6, num_points=14_000, boxes=16)
CONFIG = FindPlacesConfig(neighbours=0, spacing_m=0.5, min_path_m=6.0)


def somewhere(seed: int) -> SE3:
    """Return a level pose in the hall, turned any way."""
    x, y, yaw = np.random.default_rng(seed).uniform([-3, -2, -np.pi], [3, 2, np.pi])
    return SE3.exp([0, 0, 0, x, y, 0]) @ SE3.exp([0, 0, yaw, 0, 0, 0])


def test_I12_two_robots_merge_from_an_unknown_start(tmp_path: Path) -> None:
    """The second drives the other way round from another place; every closure is true, and it is anchored by them."""
    there, back = circle(12), [T @ SE3.exp([0, 0, np.pi, 0, 0, 0]) for T in circle(12)[::-1]][6:]
    first = stored(submap_of(there, world=HALL), tmp_path)
    second = stored(submap_of(back, world=HALL, mission=OTHER_MISSION, seed=90), tmp_path)

    found, report = find_places(both(first, second), CONFIG, tmp_path)

    assert report.num_between >= 4
    assert worst_edge_m(found, SOURCE, [there, back]) < 0.03
    assert found.missions.is_base_frame_known.all()
    assert check_map(found) == []
    solved, _ = optimize_map(found)
    T_map_first, T_map_second = (
        SE3(solved.T_map_base(solved.vertices_of(mission)[:1])[0]) for mission in (0, 1)
    )
    expected = T_map_first @ there[0].inverse() @ back[0]
    assert np.linalg.norm((expected.inverse() @ T_map_second).t) < 0.05


def test_I12_another_building_closes_no_loop(tmp_path: Path) -> None:
    first = stored(submap_of(circle(8)[:5], world=HALL), tmp_path)
    second = stored(submap_of(circle(8)[:5], world=OTHER_HALL, mission=OTHER_MISSION), tmp_path)

    found, report = find_places(both(first, second), CONFIG, tmp_path)

    assert report.num_between == 0
    assert not found.missions.is_base_frame_known[1]
    assert "no loop leads" in report.anchored[OTHER_MISSION]


def test_I12_a_mission_closes_its_own_loops_without_a_guess(tmp_path: Path) -> None:
    """Looks do not care how far odometry is off when the robot is back."""
    truth = circle(10)
    drift = SE3.exp([0, 0, 0.01, 0.03, 0.03, 0.02])
    map_ = stored(submap_of(truth, drift, world=HALL), tmp_path)

    found, report = find_places(map_, CONFIG, tmp_path)
    solved, _ = optimize_map(found)

    assert report.num_within >= 1
    assert worst_edge_m(found, SOURCE, [truth]) < 0.03
    assert rms_m(solved, truth) < rms_m(map_, truth) / 3


def test_I12_loops_with_which_too_few_agree_do_not_count(tmp_path: Path) -> None:
    first = stored(submap_of(circle(8)[:3], world=HALL), tmp_path)
    second = stored(submap_of(circle(8)[:2], world=HALL, mission=OTHER_MISSION), tmp_path)

    found, report = find_places(both(first, second), CONFIG, tmp_path)

    assert report.num_between == 0
    assert report.num_alone == 2
    assert not found.missions.is_base_frame_known[1]
    again, _ = find_places(both(first, second), CONFIG, tmp_path)
    assert again.digest() == found.digest()


def test_places_are_told_apart_by_registration_when_looks_are_forced(tmp_path: Path) -> None:
    """With a bar so low that anything is proposed, registration refuses another building."""
    options = {"min_inliers": 3, "max_differing_bits": 120}
    config = PlaceMatchingConfig(recognizer_options=options)
    clouds = [seen_from(HALL, somewhere(k), k) for k in range(3)]
    matcher = PlaceMatcher(config, lambda key: clouds[key])
    for key in range(3):
        matcher.add(key)

    judged = matcher.recognize(seen_from(OTHER_HALL, somewhere(9), 9))

    assert judged
    assert all("inlier fraction" in each.verdict or "rmse" in each.verdict for each in judged)


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_a_planar_motion_is_found_among_false_pairs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    yaw, x, y = rng.uniform([-np.pi, -20, -20], [np.pi, 20, 20])
    source = rng.uniform(-20, 20, (60, 2))
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    target = source @ turn.T + [x, y] + rng.normal(0, 0.05, (60, 2))
    target[40:] = rng.uniform(-20, 20, (20, 2))

    motion = planar_motion(source, target, tolerance_m=0.6, num_samples=500, seed=1)

    assert motion.is_inlier[:40].sum() >= 38
    assert np.allclose(motion.T_target_source.t, [x, y, 0], atol=0.1)
    assert np.allclose(motion.T_target_source.R[:2, :2], turn, atol=0.01)


def test_no_motion_explains_what_has_nothing_in_common() -> None:
    two = np.array([[0.0, 0.0], [5.0, 0.0]])

    assert planar_motion(two, two, tolerance_m=0.6, num_samples=10, seed=0).num_inliers == 0


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-3, 3))
@settings(max_examples=20, deadline=None)
def test_a_tilted_base_is_levelled_over_the_ground(roll: float, pitch: float, yaw: float) -> None:
    T_world_base = SE3.exp([0, 0, yaw, 0.5, 0.3, 0.1]) @ SE3.exp([roll, pitch, 0, 0, 0, 0])
    points = seen_from(HALL, T_world_base, 3)

    T_level_world = levelling(points, 30.0) @ T_world_base.inverse()

    assert np.degrees(np.arccos(min(T_level_world.R[2, 2], 1.0))) < 1.0
    assert abs((T_level_world @ np.array([[0.5, 0.3, -2.0]]))[0, 2]) < 0.1


def test_a_cloud_without_ground_is_refused() -> None:
    with pytest.raises(EstimationError, match="too few to find the ground"):
        levelling(np.zeros((5, 3)), 30.0)
    ramp = np.random.default_rng(0).uniform(-10, 10, (2000, 3))
    ramp[:, 2] = ramp[:, 0]
    with pytest.raises(EstimationError, match="tilted by 45 deg"):
        levelling(ramp, 30.0)


def test_a_recogniser_that_is_not_there_says_what_is() -> None:
    with pytest.raises(
        ConfigError, match="unknown recogniser of places 'nose'; known: birds_eye, map_closures"
    ):
        make_recognizer("nose", {})
    if importlib.util.find_spec("map_closures") is None:
        with pytest.raises(ConfigError, match=r"pip install 'mapstream\[closures\]'"):
            make_recognizer("map_closures", {})


def test_I12_map_closures_recognises_the_hall() -> None:
    pytest.importorskip("map_closures", reason="the extra `closures` is not installed")
    recognizer = make_recognizer("map_closures", {"density_map_resolution": 0.1})
    for key in range(6):
        recognizer.add(100 + key, seen_from(HALL, somewhere(key), key))
    T_query = somewhere(50)

    best = recognizer.propose(seen_from(HALL, T_query, 50))[0]

    expected = somewhere(best.key - 100).inverse() @ T_query
    assert np.linalg.norm((expected.inverse() @ best.T_place_query).t) < 0.5


@pytest.mark.anyio
async def test_I12_live_missions_find_each_other_and_wait_for_agreement() -> None:
    """Loops between missions come with the third that agrees; the second robot starts anywhere."""
    there, back = circle(10)[:7], [T @ SE3.exp([0, 0, np.pi, 0, 0, 0]) for T in circle(10)[2:7]]
    first = submap_of(there, SE3.identity(), world=HALL)
    second = submap_of(back, SE3.identity(), world=HALL, mission=OTHER_MISSION, seed=60)
    config = LidarPlacesConfig.model_validate(CONFIG.model_dump())

    reports = (await run_operator(LidarPlaces(config), submaps=[first, second]))["loops"]

    assert [report.stamp_ns for report in reports] == [first.stamp_ns, second.stamp_ns]
    edges = reports[1].edges
    assert len(edges) >= 3
    for edge in edges:
        assert (edge.mission_a, edge.mission_b) == (MISSION, OTHER_MISSION)
        T_a_b = there[edge.stamp_a_ns // 10**9].inverse() @ back[edge.stamp_b_ns // 10**9]
        assert np.linalg.norm((T_a_b.inverse() @ edge.T_a_b).t) < 0.03
        assert edge.is_switchable
    assert len({(edge.stamp_a_ns, edge.stamp_b_ns) for edge in edges}) == len(edges)
    maps = (
        await run_operator(Optimizer(OptimizerConfig()), submaps=[first, second], loops=reports)
    )["maps"]
    T_map_first, T_map_second = (
        SE3(maps[-1].T_map_base(maps[-1].vertices_of(mission)[:1])[0]) for mission in (0, 1)
    )
    assert (
        np.linalg.norm((there[0].inverse() @ back[0]).t - (T_map_first.inverse() @ T_map_second).t)
        < 0.03
    )


def test_I12_real_submaps_are_recognised_and_registered() -> None:
    """Five submaps of KITTI 07, each turned and moved at will: all are found, within 3 cm of the reference."""
    folder = shared("kitti07_submaps")
    lines = [line.split() for line in (folder / "graph.txt").read_text().splitlines()]
    rows = [np.array(line[1:], float) for line in lines if line and line[0].startswith("v")]
    poses = [SE3.from_quat_xyzw(row[3:], row[:3]) for row in rows]
    clouds = [
        np.fromfile(folder / f"{k:06d}" / "points.bin", np.float32).reshape(-1, 3).astype(float)
        for k in range(5)
    ]
    carried = SE3.exp([0, 0, 2.0, 5.0, -3.0, 0])
    config = PlaceMatchingConfig(
        voxel_size_m=0.5, search_distances_m=(2.0, 0.8), inlier_distance_m=0.2
    )
    for query in range(5):
        matcher = PlaceMatcher(config, lambda key: clouds[key])
        for key in (k for k in range(5) if k != query):
            matcher.add(key)

        found = matcher.recognize(carried.inverse() @ clouds[query])[-1]

        assert found.verdict == "accepted"
        assert found.result is not None
        expected = poses[found.proposal.key].inverse() @ poses[query] @ carried
        assert np.linalg.norm((expected.inverse() @ found.result.T_target_source).t) < 0.03


def test_U5_a_lidar_closes_loops_in_a_map_that_cameras_made(tmp_path: Path) -> None:
    """A camera's mission whose keyframes have clouds; a robot with a LiDAR alone is anchored in it."""
    there = made_maps.circle(7)
    seen = made_maps.flight(
        made_maps.room(0, 200), MISSION, there, {"camera": scenes.camera()}, drift=0
    )
    keyframes = [
        replace(
            frame,
            cloud=PointCloud(
                stamp_ns=frame.stamp_ns, points=seen_from(HALL, T, k).astype(np.float32)
            ),
        )
        for k, (frame, T) in enumerate(zip(seen.keyframes, there, strict=True))
    ]
    first, _ = create_landmarks(stored(replace(seen, keyframes=tuple(keyframes)), tmp_path))
    back = [T @ SE3.exp([0, 0, np.pi, 0, 0, 0]) for T in made_maps.circle(7)[::-1][:5]]
    second = stored(submap_of(back, world=HALL, mission=OTHER_MISSION, seed=70), tmp_path)

    found, report = find_places(both(first, second), CONFIG, tmp_path)

    assert len(found.landmarks) == len(first.landmarks) > 0
    assert report.num_between >= 3
    assert found.missions.is_base_frame_known.all()
    assert check_map(found) == []
    for row in np.flatnonzero(found.edges.source == SOURCE).tolist():
        a, b = found.edges.vertex_a[row], found.edges.vertex_b[row]
        period_ns = made_maps.PERIOD_NS
        T_a = there[round((found.vertices.stamp_ns[a] - keyframes[0].stamp_ns) / period_ns)]
        T_a_b = T_a.inverse() @ back[int(found.vertices.stamp_ns[b]) // 10**9]
        assert np.linalg.norm((T_a_b.inverse() @ found.edges.T_a_b_of(row)).t) < 0.03
