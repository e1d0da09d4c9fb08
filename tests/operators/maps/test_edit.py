"""Edits by hand change what they say, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from mapstream.operators.maps.anchor import anchor, release
from mapstream.operators.maps.edit import (
    Chosen,
    Disturbance,
    Switch,
    Uncertainty,
    chosen_edges,
    disturb,
    set_switch,
    set_uncertainty,
)
from mapstream.operators.maps.merge import merge
from mapstream.operators.maps.missions import find_mission
from mapstream.recordings.maps import Map, check_map
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from tests.recordings.made_maps import MISSION, OTHER_MISSION, full_map, line_map


def unchanged_tables(a: Map, b: Map) -> set[str]:
    return {name for name, table in a.tables().items() if table is b.tables()[name]}


def test_M13_uncertainties_are_set_by_kind() -> None:
    map_ = full_map()
    rows = chosen_edges(map_, Chosen(kind="odometry"))

    edited = set_uncertainty(map_, rows, Uncertainty(translation_sigma_m=0.5, factor=2.0))

    expected = np.diag([4e-4] * 3 + [0.25] * 3)
    np.testing.assert_allclose(edited.edges.covariance[rows], np.tile(expected, (5, 1, 1)))
    np.testing.assert_array_equal(edited.edges.covariance[5:], map_.edges.covariance[5:])
    assert unchanged_tables(map_, edited) == set(map_.tables()) - {"edges"}
    assert check_map(edited) == []


def test_M13_a_direction_that_was_not_measured_stays_so() -> None:
    map_ = full_map()

    edited = set_uncertainty(map_, np.array([5]), Uncertainty(rotation_sigma_rad=0.1))

    np.testing.assert_array_equal(edited.edges.covariance[5], map_.edges.covariance[5])


def test_M13_switches_are_set_by_edge() -> None:
    map_ = full_map()

    edited = set_switch(map_, np.array([3]), Switch(value=0.0, variance=0.1, is_switchable=True))

    assert edited.edges.switch.tolist() == [1, 1, 1, 0, *[1] * 7]
    assert edited.edges.switch_variance[3] == 0.1
    assert np.flatnonzero(edited.edges.is_switchable).tolist() == [3]
    with pytest.raises(ValidationError, match="less than or equal to 1"):
        Switch(value=1.5)


def test_M13_noise_is_seeded_and_leaves_the_first_vertices() -> None:
    map_, _ = merge([full_map(), line_map(4, OTHER_MISSION)])

    noisy, again = (disturb(map_, Disturbance(seed=3)) for _ in range(2))
    other, one = disturb(map_, Disturbance(seed=4)), disturb(map_, Disturbance(), mission_row=1)

    assert noisy.digest() == again.digest() != other.digest()
    moved = np.abs(noisy.vertices.T_mission_base - map_.vertices.T_mission_base).max(axis=(1, 2))
    assert np.flatnonzero(moved == 0).tolist() == [0, 6]
    np.testing.assert_array_equal(one.vertices.T_mission_base[:7], map_.vertices.T_mission_base[:7])
    assert check_map(noisy) == []


def test_edges_are_chosen_by_all_that_is_given() -> None:
    map_, _ = merge([full_map(), line_map(4, OTHER_MISSION)])

    assert chosen_edges(map_, Chosen(kind="odometry", mission_row=1)).tolist() == [11, 12, 13]
    assert chosen_edges(map_, Chosen(kind="odometry", source="odometry", rows=(2, 7))).tolist() == [
        2
    ]
    with pytest.raises(MapError, match=r"no edge is chosen by \{'kind': 'loop'\}.*absolute, imu"):
        chosen_edges(map_, Chosen(kind="loop"))


def test_H15_a_base_frame_is_set_known_and_unknown() -> None:
    map_, _ = merge([full_map(), line_map(4, OTHER_MISSION)])
    T = SE3.exp([0, 0, 1.0, 5.0, 0, 0])

    placed, kept, freed = anchor(map_, 1, T), anchor(map_, 1), release(map_, 0)

    assert placed.missions.is_base_frame_known.tolist() == [True, True]
    np.testing.assert_array_equal(placed.missions.T_map_mission[1], T.matrix)
    np.testing.assert_array_equal(kept.missions.T_map_mission, map_.missions.T_map_mission)
    assert kept.missions.is_base_frame_known.tolist() == [True, True]
    assert freed.missions.is_base_frame_known.tolist() == [False, False]


def test_missions_are_found_by_digits_and_by_name() -> None:
    map_, _ = merge([full_map(), line_map(4, OTHER_MISSION)])

    assert [find_mission(map_, text) for text in (MISSION, "a0")] == [0, 1]
    assert find_mission(full_map(), "line") == 0
    with pytest.raises(MapError, match=r"several missions are called 'line'; the map has 0f0f"):
        find_mission(map_, "line")
    with pytest.raises(MapError, match="no mission is called 'x'"):
        find_mission(map_, "x")
