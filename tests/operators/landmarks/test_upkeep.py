"""Landmarks judged, removed and merged."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapstream.operators.landmarks.covisibility import common_with_next
from mapstream.operators.landmarks.create import create_landmarks
from mapstream.operators.landmarks.merging import merge_landmarks
from mapstream.operators.landmarks.quality import (
    PointQuality,
    QualityConfig,
    RayQuality,
    evaluate_quality,
    reset_quality,
)
from mapstream.operators.landmarks.removal import (
    InvalidConfig,
    remove_bad_landmarks,
    remove_invalid_observations,
)
from mapstream.operators.landmarks.views import T_map_sensor_of
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Observations
from mapstream.streams.errors import MapError
from tests.operators.estimation.problems import with_landmark, with_mission
from tests.operators.vision_worlds import World, with_true_landmarks


def seen_from(places: list[float], *, distance_m: float = 10.0, points: bool = False) -> Map:
    """A landmark straight ahead, seen from places beside each other [m]."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, 1, 3] = places
    place = np.eye(4)
    place[0, 3] = distance_m
    map_ = with_landmark(with_mission(poses), "brisk", place)
    seen = Observations(
        vertex=np.arange(len(places)),
        landmark=np.zeros(len(places), np.int64),
        sensor=np.full(len(places), "left", object),
        kind=np.full(len(places), "brisk", object),
        keypoint_px=np.full((len(places), 2), np.nan if points else 200.0),
        p_sensor=np.array([place[:3, 3] - pose[:3, 3] for pose in poses]) if points else np.full((len(places), 3), np.nan),
    )  # fmt: skip
    return replace(map_, observations=seen)


def apart(angle_rad: float, distance_m: float = 10.0) -> list[float]:
    """Four places from which a point is seen under this angle."""
    half = distance_m * np.tan(angle_rad / 2)
    return [-half, -half / 3, half / 3, half]


@pytest.mark.parametrize(
    ("map_", "quality"),
    [
        (seen_from(apart(np.deg2rad(5.01))), "good"),
        (seen_from(apart(np.deg2rad(4.99))), "bad"),
        (seen_from(apart(0.2)[:3]), "bad"),  # three observers
        (seen_from([-3, -1, 1, 3], distance_m=39.9), "good"),
        (seen_from([-3, -1, 1, 3], distance_m=40.1), "bad"),
        (seen_from([-1, 0, 1, 2], distance_m=0.051), "good"),
        (seen_from([-1, 0, 1, 2], distance_m=0.049), "bad"),
    ],
)
def test_E6_each_criterion_has_its_boundary(map_: Map, quality: str) -> None:
    """Four observers, 5 degrees, the nearest between 5 cm and 40 m."""
    judged, report = evaluate_quality(map_)

    assert judged.landmarks.quality.tolist() == [quality]
    assert report.num == {quality: 1}
    assert bool(report.failed) == (quality == "bad")


def test_E6_errors_count_if_they_shall() -> None:
    """A landmark 3 px from where it was seen is bad from a limit of 2 px on; resetting forgets it."""
    world = World(num_points=30)
    map_ = with_true_landmarks(world, world.map())
    px = map_.observations.keypoint_px.copy()
    px[0] += [3, 0]
    map_ = replace(map_, observations=replace(map_.observations, keypoint_px=px))
    config = QualityConfig(rays=RayQuality(min_observers=1, min_parallax_rad=0, max_reprojection_error_px=2))  # fmt: skip

    judged, report = evaluate_quality(map_, config)
    forgotten, num = reset_quality(judged)

    bad = np.flatnonzero(judged.landmarks.quality == "bad")
    assert bad.tolist() == [map_.observations.landmark[0]]
    assert report.failed == {"reprojection error": 1}
    assert set(forgotten.landmarks.quality) == {"unknown"}
    assert num == len(map_.landmarks)


@pytest.mark.parametrize(
    ("distance_m", "quality"), [(0.99, "bad"), (1.01, "good"), (59.9, "good"), (60.1, "bad")]
)
def test_E7_points_have_criteria_of_their_own(distance_m: float, quality: str) -> None:
    """One observer suffices, from 1 to 60 m."""
    judged, _ = evaluate_quality(seen_from([0.0], distance_m=distance_m, points=True))

    assert judged.landmarks.quality.tolist() == [quality]


def test_an_object_that_was_seen_from_near_keeps_its_quality() -> None:
    map_ = seen_from([0.0], distance_m=0.5, points=True)
    kind = np.array(["object"], object)
    map_ = replace(map_, landmarks=replace(map_.landmarks, kind=kind))

    judged, report = evaluate_quality(map_)

    assert judged.landmarks.quality.tolist() == ["unknown"]
    assert report.failed == {}


def test_E7_points_far_from_the_landmark_are_bad_if_they_shall() -> None:
    """An error of 10 cm passes a limit of 11, not of 9."""
    map_ = seen_from([0.0], points=True)
    map_ = replace(map_, landmarks=replace(map_.landmarks, p_base=map_.landmarks.p_base + np.array([0.1, 0, 0])))  # fmt: skip

    found = [
        evaluate_quality(map_, QualityConfig(points=PointQuality(max_error_m=limit)))[0]
        for limit in (0.11, 0.09)
    ]

    assert [m.landmarks.quality[0] for m in found] == ["good", "bad"]


def test_E10_bad_landmarks_go_and_their_keypoints_stay() -> None:
    """Counts are those of the map before; no reference dangles."""
    world = World(num_points=40)
    map_ = world.with_odometry(with_true_landmarks(world, world.map()), noisy=False)
    quality = np.where(np.arange(len(map_.landmarks)) % 3 == 0, "bad", "good").astype(object)
    map_ = replace(map_, landmarks=replace(map_.landmarks, quality=quality))
    of_bad = quality[map_.observations.landmark] == "bad"

    left, report = remove_bad_landmarks(map_)

    assert report.num_landmarks == (quality == "bad").sum()
    assert report.num_observations == of_bad.sum()
    assert len(left.observations) == len(map_.observations)
    assert (left.observations.landmark < 0).tolist() == of_bad.tolist()
    assert check_map(left) == []


def test_E10_observations_that_cannot_be_true_lose_their_landmark() -> None:
    """Far from the keypoint, or behind the camera; a landmark that nobody sees any more goes, too."""
    world = World(num_points=40)
    map_ = world.with_odometry(with_true_landmarks(world, world.map()), noisy=False)
    px, p_base = map_.observations.keypoint_px.copy(), map_.landmarks.p_base.copy()
    px[5] += [60, 0]
    behind = int(map_.observations.landmark[20])
    p_base[behind] = [-3, 0, 0]
    map_ = replace(
        map_,
        observations=replace(map_.observations, keypoint_px=px),
        landmarks=replace(map_.landmarks, p_base=p_base),
    )
    expected = np.flatnonzero(map_.observations.landmark == behind).tolist()

    left, report = remove_invalid_observations(map_)

    assert np.flatnonzero(left.observations.landmark < 0).tolist() == sorted({5, *expected})
    assert report.num_landmarks == 1
    assert check_map(left) == []


def test_E10_of_points_beyond_the_reach_of_a_pair_the_first_camera_counts() -> None:
    world = World(num_points=40)
    map_ = world.with_odometry(with_true_landmarks(world, world.map()), noisy=False)
    seen = map_.observations
    places = T_map_sensor_of(map_, np.arange(len(seen)))[:, :3, 3]
    points = map_.T_map_landmark(seen.landmark)[:, :3, 3]
    expected = []
    for row in range(len(seen)):
        beside = np.flatnonzero(
            (seen.vertex == seen.vertex[row]) & (seen.landmark == seen.landmark[row])
        )
        before = beside[beside < row]
        if len(before):
            baseline_m = np.linalg.norm(places[row] - places[before[-1]])
            if np.linalg.norm(points[row] - places[row]) > 20 * baseline_m:
                expected.append(row)

    left, report = remove_invalid_observations(map_, InvalidConfig(most_baselines=20))

    freed = np.flatnonzero(left.observations.landmark < 0)
    assert freed.tolist() == expected
    assert 0 < report.num_observations < len(seen)
    assert report.num_landmarks == 0


def test_E11_merged_landmarks_have_the_observations_of_all() -> None:
    """Within a mission and between two; pairs of pairs; tracks and edges come along."""
    world, other = World(num_points=30), World(num_points=30, mission="6b" * 16)
    map_ = other.map(world.map())
    map_, _ = create_landmarks(map_)
    seen = map_.observations
    first, second = (np.flatnonzero(map_.vertices.mission[map_.landmarks.vertex] == m) for m in (0, 1))  # fmt: skip
    pairs = np.array([[first[0], second[0]], [second[0], second[1]], [first[2], second[2]]])

    merged, report = merge_landmarks(map_, pairs)

    assert report.num_merged == 3
    assert report.num_between_missions == 3
    assert len(merged.landmarks) == len(map_.landmarks) - 3
    of_all = np.isin(seen.landmark, [first[0], second[0], second[1]])
    assert set(merged.observations.landmark[of_all]) == {0}
    assert (merged.observations.landmark == 0).sum() == of_all.sum()
    assert (merged.observations.track == seen.track).all()
    assert {finding.rule for finding in check_map(merged)} == {"missions_are_connected"}


def test_E11_kinds_never_meet() -> None:
    """Nor do rows that are not there."""
    map_ = with_landmark(with_landmark(with_mission(np.eye(4)[None]), "brisk", np.eye(4)), "sift", np.eye(4))  # fmt: skip

    with pytest.raises(MapError, match="kinds never meet"):
        merge_landmarks(map_, np.array([[0, 1]]))
    with pytest.raises(MapError, match="outside 0 to 1"):
        merge_landmarks(map_, np.array([[0, 2]]))


def test_consecutive_vertices_have_points_in_common() -> None:
    """By track before there are landmarks, by landmark after."""
    world = World(num_points=50)
    map_ = world.map()
    made, _ = create_landmarks(map_)
    vertices = map_.vertices_of(0)
    tracks = [set(map_.observations.track[map_.observations.vertex == v]) for v in vertices]

    counts = common_with_next(map_, vertices)

    assert counts.tolist() == [len(a & b) for a, b in pairwise(tracks)]
    assert common_with_next(made, vertices).tolist() == counts.tolist()
