"""Maps grow by submaps, and stay what they were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.recordings.maps.build import add_edges, with_poses
from mapstream.recordings.maps.combine import merge_maps, select_missions, with_journal_entry
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import Submap
from tests.recordings.made_maps import (
    MISSION,
    OTHER_MISSION,
    STEP,
    edge,
    full_map,
    keyframe,
    line_map,
    submaps,
)


def appended(parts: list[Submap]) -> Map:
    map_ = Map.empty()
    for part in parts:
        map_ = append_submap(map_, part)
    return map_


@settings(max_examples=30)
@given(st.sets(st.integers(1, 11)))
def test_a_map_of_submaps_equals_the_uncut_map(cuts: set[int]) -> None:
    uncut = appended(submaps([12]))

    cut = appended(submaps([*sorted(cuts), 12]))

    np.testing.assert_allclose(
        cut.vertices.T_mission_base, uncut.vertices.T_mission_base, atol=1e-9
    )
    same_poses = replace(
        cut.vertices,
        T_mission_base=uncut.vertices.T_mission_base,
        velocity_mps=uncut.vertices.velocity_mps,
    )
    assert replace(cut, vertices=same_poses).digest() == uncut.digest()


def test_new_vertices_follow_an_optimised_mission() -> None:
    first, second = submaps([3, 6])
    moved = SE3.exp([0.1, 0.2, 0.3, 4.0, 5.0, 6.0]).matrix
    map_ = append_submap(Map.empty(), first)
    rows = np.arange(4)
    map_ = with_poses(map_, rows, moved @ map_.vertices.T_mission_base[rows])

    map_ = append_submap(map_, second)

    steps = np.linalg.inv(map_.vertices.T_mission_base[:-1]) @ map_.vertices.T_mission_base[1:]
    np.testing.assert_allclose(steps, np.tile(STEP.matrix, (6, 1, 1)), atol=1e-9)
    forward = np.linalg.inv(map_.vertices.T_mission_base[5, :3, :3]) @ map_.vertices.velocity_mps[5]
    np.testing.assert_allclose(forward, [2.0, 0, 0], atol=1e-9)


def test_an_edit_shares_the_tables_it_does_not_touch() -> None:
    map_ = full_map()

    moved = with_poses(map_, np.array([1]), np.eye(4))

    assert moved.edges is map_.edges
    assert moved.observations is map_.observations
    assert moved.vertices.stamp_ns.base is map_.vertices.stamp_ns.base
    assert not np.array_equal(map_.vertices.T_mission_base[1], np.eye(4))


def test_columns_are_read_only() -> None:
    with pytest.raises(ValueError, match="read-only"):
        line_map(3).vertices.stamp_ns[0] = 0


@pytest.mark.parametrize("order", [[1], [0, 0], [0, 2]])
def test_submaps_out_of_order_are_refused(order: list[int]) -> None:
    parts = submaps([3, 6, 9])

    with pytest.raises(MapError, match=f"submap {order[-1]} of mission {MISSION}.*append"):
        appended([parts[i] for i in order])


def test_an_edge_to_nowhere_is_refused() -> None:
    stray = edge(keyframe(0), keyframe(40))

    with pytest.raises(MapError, match=f"mission {MISSION} has no vertex at 20000001000 ns"):
        add_edges(line_map(3), [stray])


def test_equal_measurements_get_ids_of_their_own() -> None:
    again = edge(keyframe(0), keyframe(1))

    map_ = add_edges(add_edges(line_map(3), [again]), [again, again])

    assert len(np.unique(map_.edges.id, axis=0)) == len(map_.edges) == 5


def test_G9_several_missions_are_queried_apart() -> None:
    map_ = appended([*submaps([4]), *submaps([2], OTHER_MISSION)])

    first, second = (map_.trajectory(mission) for mission in (MISSION, OTHER_MISSION))

    assert len(np.unique(map_.vertices.id, axis=0)) == 8
    assert (len(first), len(second)) == (5, 3)
    np.testing.assert_array_equal(map_.missions.is_base_frame_known, [True, False])
    with pytest.raises(MapError, match="no mission"):
        map_.trajectory("00" * 16)


def test_a_merged_map_gives_its_parts_back() -> None:
    a, b = full_map(), line_map(4, OTHER_MISSION)

    merged = merge_maps([a, b], share_frame=True)

    assert select_missions(merged, [MISSION]).digest() == a.digest()
    assert select_missions(merged, [OTHER_MISSION]).digest() == b.digest()
    assert not merge_maps([a, b]).missions.is_base_frame_known[1]


def test_merging_a_mission_with_itself_is_refused() -> None:
    with pytest.raises(MapError, match=f"both maps hold mission.*{MISSION}"):
        merge_maps([line_map(3), line_map(4)])


@settings(max_examples=30)
@given(st.lists(st.booleans(), min_size=6, max_size=6))
def test_selecting_vertices_leaves_no_dangling_reference(kept: list[bool]) -> None:
    map_ = full_map()

    part = map_.select(vertices=np.array(kept))

    assert len(part.vertices) == sum(kept)
    stamps = part.vertices.stamp_ns
    np.testing.assert_array_equal(stamps, map_.vertices.stamp_ns[np.array(kept)])
    for rows, target in (
        (part.edges.vertex_a, part.vertices),
        (part.edges.vertex_b[part.edges.kind != "absolute"], part.vertices),
        (part.imu.edge, part.edges),
        (part.landmarks.vertex, part.vertices),
        (part.resources.vertex, part.vertices),
    ):
        assert ((rows >= 0) & (rows < len(target))).all()
    assert set(part.edges.kind[part.imu.edge]) <= {"imu"}


def test_the_journal_holds_no_time() -> None:
    a = with_journal_entry(line_map(3), "sparsify", keep=100, mode="random")
    b = with_journal_entry(line_map(3), "sparsify", mode="random", keep=100)

    assert a.digest() == b.digest() != line_map(3).digest()


def test_wrong_columns_are_refused() -> None:
    vertices = line_map(3).vertices

    with pytest.raises(ValueError, match=r"Vertices.T_mission_base: expected shape \(3, 4, 4\)"):
        replace(vertices, T_mission_base=np.eye(4)[None])
    with pytest.raises(ValueError, match=r"Edges.kind: expected <class 'str'>, got \['int'\]"):
        replace(line_map(2).edges, kind=np.array([7], dtype=object))
    with pytest.raises(ValueError, match="Vertices: the column mission is missing"):
        type(vertices)(id=vertices.id)


def test_masks_for_no_table_are_refused() -> None:
    with pytest.raises(ValueError, match="a mask of 3 rows for vertexes; the tables have"):
        line_map(3).select(vertexes=np.ones(3, dtype=bool))
    with pytest.raises(ValueError, match="a mask of 2 rows for vertices"):
        line_map(3).select(vertices=np.ones(2, dtype=bool))
