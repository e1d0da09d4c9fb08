"""What stays after a part is taken out is a map, and says the same as before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.maps.composing import Motion, composed
from mapstream.operators.maps.merge import merge
from mapstream.operators.maps.remove import Gap, remove_missions, remove_range
from mapstream.operators.maps.residuals import chi2, relative_edges
from mapstream.operators.maps.split import split_mission
from mapstream.recordings.maps import Map, check_map
from mapstream.recordings.maps.build import append_edges
from mapstream.recordings.maps.semantic_tables import Detections
from mapstream.recordings.maps.tables import Edges, Observations
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3, se3_exp, se3_log
from tests.recordings.made_maps import MISSION, OTHER_MISSION, full_map, line_map


def gap(map_: Map, first: int, last: int, across: str = "link") -> Gap:
    """The time of these vertices."""
    stamps_ns = map_.vertices.stamp_ns
    return Gap(start_ns=int(stamps_ns[first]), end_ns=int(stamps_ns[last]), across=across)  # type: ignore[arg-type]  # checked


@settings(max_examples=15)
@given(st.integers(0, 7), st.integers(0, 7), st.sampled_from(["link", "split"]))
def test_M17_what_stays_is_a_clean_map(a: int, b: int, across: str) -> None:
    for whole in (full_map(), line_map(8)):
        first, last = sorted((min(a, len(whole.vertices) - 1), min(b, len(whole.vertices) - 1)))
        if last - first + 1 == len(whole.vertices):
            continue

        left, report = remove_range(whole, 0, gap(whole, first, last, across))

        assert check_map(left) == []
        assert report.num_vertices == last - first + 1
        assert len(left.vertices) == len(whole.vertices) - report.num_vertices


def test_M17_edges_over_the_gap_measure_what_those_in_it_did() -> None:
    map_ = line_map(8)

    left, report = remove_range(map_, 0, gap(map_, 2, 4))

    assert (report.num_links, report.new_missions) == (1, ())
    assert len(left.edges) == 4
    np.testing.assert_allclose(chi2(left, relative_edges(left)), 0, atol=1e-12)
    [bridge] = np.flatnonzero(left.edges.vertex_b - left.edges.vertex_a != 1).tolist() or [3]
    steps = [Motion(map_.edges.T_a_b_of(row), map_.edges.covariance[row]) for row in range(1, 5)]
    np.testing.assert_allclose(left.edges.covariance[bridge], composed(steps).covariance)


def test_M17_imu_edges_are_joined_over_the_gap_with_all_their_samples() -> None:
    map_ = full_map()

    left, _ = remove_range(map_, 0, gap(map_, 2, 3))

    imu = left.edges_of("imu")
    assert len(imu) == 3
    joined = left.imu.stamp_ns[left.imu.edge == imu[-1]]
    expected = np.unique(map_.imu.stamp_ns[np.isin(map_.imu.edge, [6, 7, 8])])
    np.testing.assert_array_equal(joined, expected)


def test_M17_a_cut_makes_the_rest_a_mission_of_its_own_in_the_same_place() -> None:
    map_ = full_map()
    before = map_.T_map_base(np.arange(6))

    left, report = remove_range(map_, 0, gap(map_, 2, 2, "split"))

    [mission_id] = report.new_missions
    assert [left.mission_id(row) for row in range(2)] == [MISSION, mission_id]
    assert left.vertices.mission.tolist() == [0, 0, 1, 1, 1]
    np.testing.assert_allclose(left.T_map_base(np.arange(5)), np.delete(before, 2, axis=0))
    assert split_mission(map_, 0, int(map_.vertices.stamp_ns[3]))[1] == mission_id


def test_M17_a_mission_that_nothing_joins_any_more_becomes_two() -> None:
    map_ = line_map(6)
    loop = Edges(
        kind=np.array(["sonar"], dtype=object), vertex_a=np.array([1]), vertex_b=np.array([3])
    )
    kinds = map_.edges.kind.copy()
    kinds[2] = "sonar"  # of which nobody knows how to compose it
    map_ = replace(map_, edges=replace(map_.edges, kind=kinds))

    _, apart = remove_range(map_, 0, gap(map_, 2, 2))
    joined, together = remove_range(append_edges(map_, loop), 0, gap(map_, 2, 2))

    assert len(apart.new_missions) == 1
    assert together.new_missions == ()
    assert check_map(joined) == []


def test_M17_landmarks_that_others_see_stay_where_they_are() -> None:
    map_ = full_map()
    seen = Observations(
        vertex=np.array([0, 4]),
        landmark=np.array([0, 0]),
        sensor=np.array(["camera"] * 2, dtype=object),
        keypoint_px=np.ones((2, 2), dtype=np.float32),
    )
    map_ = replace(map_, observations=seen, detections=Detections())
    quat = map_.landmarks.quat_base_xyzw.copy()
    quat[0] = SE3.exp([0.3, 0.2, 0.1, 0, 0, 0]).quat_xyzw
    map_ = replace(map_, landmarks=replace(map_.landmarks, quat_base_xyzw=quat))
    before = map_.T_map_landmark(np.array([0]))

    left, _ = remove_range(map_, 0, gap(map_, 0, 1))

    assert left.landmarks.label.tolist() == ["", "chair"]
    assert left.landmarks.vertex[0] == 2
    np.testing.assert_allclose(left.T_map_landmark(np.array([0])), before, atol=1e-12)
    assert check_map(left) == []


def test_M17_a_mission_goes_with_all_that_is_its_own() -> None:
    both, _ = merge([full_map(), line_map(4, OTHER_MISSION)])

    left, report = remove_missions(both, [1])

    assert left.digest() == full_map().digest()
    assert report.num_vertices == 4
    with pytest.raises(MapError, match="all missions would go"):
        remove_missions(both, [0, 1])


def test_times_without_vertices_are_refused() -> None:
    map_ = line_map(4)

    with pytest.raises(MapError, match="has no vertex from 5 to 6 ns"):
        remove_range(map_, 0, Gap(start_ns=5, end_ns=6))
    with pytest.raises(MapError, match=r"nothing of mission .* would be left"):
        remove_range(map_, 0, Gap())
    with pytest.raises(ValueError, match="after its end"):
        Gap(start_ns=7, end_ns=6)


def test_a_direction_that_a_step_left_open_stays_open() -> None:
    turn = SE3.exp([0, 0, np.pi / 2, 1.0, 0, 0])
    variances = np.diag([1e-4, 1e-4, 1e-4, 1e-2, np.inf, np.inf])

    forward = composed([Motion(turn, variances), Motion.exact(SE3.identity())])
    turned = composed([Motion(turn, np.diag(np.full(6, 1e-4))), Motion(turn, variances)])
    carried = composed([Motion(turn, variances), Motion.exact(turn)])

    np.testing.assert_array_equal(np.isinf(np.diagonal(forward.covariance)), [0, 0, 0, 0, 1, 1])
    np.testing.assert_array_equal(np.isinf(np.diagonal(turned.covariance)), [0, 0, 0, 0, 1, 1])
    assert np.isinf(carried.covariance[3, 3])  # y of the first step is x of the second
    assert np.isfinite(carried.covariance[4, 4])


def test_composed_covariances_are_those_of_sampled_noise() -> None:
    rng = np.random.default_rng(0)
    steps = [SE3.exp(rng.normal(size=6)) for _ in range(3)]
    C = np.diag([1e-4, 2e-4, 3e-4, 1e-4, 2e-4, 4e-4])

    expected = composed([Motion(T, C) for T in steps])

    noise = rng.normal(size=(3, 4000, 6)) * np.sqrt(np.diagonal(C))
    ends = np.eye(4)
    for step, xi in zip(steps, noise, strict=True):
        ends = ends @ step.matrix @ se3_exp(xi)
    errors = se3_log(expected.T.inverse().matrix @ ends)
    np.testing.assert_allclose(np.cov(errors.T), expected.covariance, atol=2e-4)
