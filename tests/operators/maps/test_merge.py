"""Maps that were made apart become one, and nothing is in it twice."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapstream.operators.maps.merge import MergeConfig, merge
from mapstream.recordings.maps import Map, check_map
from mapstream.recordings.maps.build import add_edges, anchored, append_edges, with_poses
from mapstream.recordings.maps.combine import select_missions
from mapstream.recordings.maps.features import descriptors_of
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.order import in_canonical_order
from mapstream.recordings.maps.tables import Edges, Frames
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import RelativePose
from tests.recordings.made_maps import COVARIANCE, MISSION, OTHER_MISSION, full_map, line_map
from tests.recordings.test_map_features import features, map_of

THIRD = "b1" * 16


def joined_by_loop(a: Map, b: Map) -> Map:
    """Both maps, with a loop between their first vertices."""
    both, _ = merge([a, b])
    mission_a, mission_b = both.mission_id(0), both.mission_id(1)
    loop = RelativePose(
        kind="loop",
        mission_a=mission_a,
        stamp_a_ns=int(a.vertices.stamp_ns[0]),
        mission_b=mission_b,
        stamp_b_ns=int(b.vertices.stamp_ns[0]),
        T_a_b=SE3.identity(),
        covariance=COVARIANCE,
    )
    return add_edges(both, [loop])


def test_M4_any_number_of_maps_become_one_and_sensors_stay_apart() -> None:
    maps = [full_map(), line_map(4, OTHER_MISSION), line_map(3, THIRD)]
    sensors = np.array(['{"lidar": 1}'], dtype=object)
    maps[1] = replace(maps[1], missions=replace(maps[1].missions, sensors=sensors))

    together, report = merge(maps)

    assert (report.num_missions, report.num_vertices, report.repeated) == (3, 13, ())
    assert together.missions.sensors.tolist() == ["{}", '{"lidar": 1}', "{}"]
    assert together.missions.is_base_frame_known.tolist() == [True, False, False]
    assert check_map(together) == []
    assert select_missions(together, [MISSION]).digest() == full_map().digest()


def test_M5_a_mission_that_both_hold_is_there_once_with_the_edges_of_both() -> None:
    common = full_map()
    a = joined_by_loop(common, line_map(4, OTHER_MISSION))
    b = joined_by_loop(common, line_map(3, THIRD))

    together, report = merge([a, b])

    assert report.repeated == (MISSION,)
    assert (len(together.missions), len(together.vertices)) == (3, 13)
    assert (together.edges.kind == "loop").sum() == 2
    assert len(together.imu) == len(common.imu)
    assert len(together.observations) == len(common.observations)
    assert len(together.resources) == 13
    assert check_map(together) == []
    assert merge([a, a])[0].digest() == a.digest()


def test_M4_a_common_mission_places_the_others() -> None:
    T = SE3.exp([0.1, 0.2, 0.3, 4.0, 5.0, 6.0])
    common, other = full_map(), line_map(4, OTHER_MISSION)
    here = anchored(common, 0, T)
    there = anchored(merge([common, other])[0], 1, SE3.exp([0, 0, 1.0, 1.0, 0, 0]))

    together, _ = merge([here, there])

    T_map_other = together.missions.T_map_mission_of(1)
    expected = T @ SE3.exp([0, 0, 1.0, 1.0, 0, 0])
    np.testing.assert_allclose(T_map_other.matrix, expected.matrix, atol=1e-12)
    assert together.missions.is_base_frame_known.tolist() == [True, True]


def test_M4_maps_that_share_a_frame_keep_their_places() -> None:
    together, _ = merge(
        [full_map(), line_map(4, OTHER_MISSION)], MergeConfig(has_common_frame=True)
    )

    assert together.missions.is_base_frame_known.tolist() == [True, True]


def test_M4_one_id_with_two_contents_is_refused_by_name() -> None:
    moved = with_poses(full_map(), np.array([2]), np.eye(4))

    with pytest.raises(
        MapError, match=rf"mission {MISSION} is in two maps, and its vertices differ"
    ):
        merge([full_map(), moved])


def test_M5_the_same_mission_may_have_its_rows_in_another_order() -> None:
    def with_fixes(names: list[str]) -> Map:
        """A position in each of two outer frames."""
        frames = Frames(
            id=id_array(derived_id("frame", name) for name in names),
            name=np.array(names, dtype=object),
        )
        fixes = Edges(
            kind=np.array(["position"] * 2, dtype=object),
            vertex_a=np.array([names.index("enu"), names.index("vicon")]),
            frame=np.array([0, 1]),
        )
        return append_edges(replace(line_map(4), frames=frames), fixes)

    a, b = with_fixes(["enu", "vicon"]), with_fixes(["vicon", "enu"])
    together, report = merge([a, b])

    assert a.frames.name.tolist() != b.frames.name.tolist()
    assert report.repeated == (MISSION,)
    assert together.digest() == a.digest()


def test_M4_one_outer_frame_with_two_origins_is_refused() -> None:
    a = full_map()
    origin = a.frames.origin_lla + 1.0
    b = replace(line_map(4, OTHER_MISSION), frames=replace(a.frames, origin_lla=origin))

    with pytest.raises(MapError, match=r"outer frame 'enu' has origin \[47\.3.*in another"):
        merge([a, b])


def part(map_: Map, first: int, last: int, T_part: SE3 | None = None) -> Map:
    """What a map holds between two of its vertices, in a mission frame of its own."""
    at = np.arange(len(map_.vertices))
    cut = map_.select(vertices=(at >= first) & (at <= last))
    T = (T_part or SE3.identity()).matrix
    vertices = cut.vertices
    turned = (T[:3, :3] @ vertices.velocity_mps[:, :, None])[:, :, 0]
    moved = replace(vertices, T_mission_base=T @ vertices.T_mission_base, velocity_mps=turned)
    return replace(cut, vertices=moved)


@pytest.mark.parametrize("seed", range(5))
def test_M5_parts_of_a_mission_join_to_the_uncut_one_in_any_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    whole = line_map(20)
    cuts = [0, *np.sort(rng.choice(np.arange(1, 19), 3, replace=False)).tolist(), 19]
    T_parts = [SE3.exp(rng.normal(size=6)) for _ in cuts[1:]]
    parts = [
        part(whole, first, last, T)
        for (first, last), T in zip(pairwise(cuts), T_parts, strict=True)
    ]
    order = rng.permutation(len(parts)).tolist()

    together, report = merge([parts[at] for at in order])

    assert report.joined == (MISSION,) * 3
    assert check_map(together) == []
    T_first = T_parts[order[0]].matrix
    expected = T_first @ whole.vertices.T_mission_base
    np.testing.assert_allclose(together.vertices.T_mission_base, expected, atol=1e-9)
    velocity = (T_first[:3, :3] @ whole.vertices.velocity_mps[:, :, None])[:, :, 0]
    np.testing.assert_allclose(together.vertices.velocity_mps, velocity, atol=1e-9)
    at_rest = replace(
        together,
        vertices=replace(
            together.vertices,
            T_mission_base=whole.vertices.T_mission_base,
            velocity_mps=whole.vertices.velocity_mps,
        ),
    )
    assert at_rest.digest() == in_canonical_order(whole).digest()


def test_M5_tracks_go_on_across_the_cuts() -> None:
    """Keypoints at a shared vertex are there once, with their tracks and descriptors."""
    whole = map_of([(features(i, "orb", 3), features(i, "sift", 2)) for i in range(7)])
    parts = [part(whole, first, last) for first, last in ((0, 2), (2, 5), (5, 6))]

    together, _ = merge([parts[at] for at in (1, 2, 0)])

    assert check_map(together) == []
    ordered = in_canonical_order(whole)
    moved = ordered.vertices.T_mission_base - together.vertices.T_mission_base
    assert np.abs(moved).max() < 1e-12
    assert replace(together, vertices=ordered.vertices).digest() == ordered.digest()
    rows = np.flatnonzero(together.observations.kind == "orb")
    expected = descriptors_of(whole, np.flatnonzero(whole.observations.kind == "orb"))
    np.testing.assert_array_equal(descriptors_of(together, rows), expected)


def test_M5_a_longer_map_of_the_same_mission_adds_what_is_new() -> None:
    whole = full_map()
    start = part(whole, 0, 3)

    longer, _ = merge([start, whole])
    shorter, report = merge([whole, start])

    assert report.joined == (MISSION,)
    assert shorter.digest() == in_canonical_order(whole).digest()
    assert longer.edges.id.tobytes() == shorter.edges.id.tobytes()
    assert len(longer.imu) == len(whole.imu)
    assert check_map(longer) == []


def test_M5_a_part_places_the_other_missions_of_its_map() -> None:
    whole, T = line_map(8), SE3.exp([0.1, 0.0, 0.5, 3.0, 2.0, 1.0])
    other = anchored(
        merge([part(whole, 4, 7, T), line_map(3, OTHER_MISSION)])[0], 1, SE3.identity()
    )

    together, _ = merge([part(whole, 0, 4), other])

    row = together.mission_row(OTHER_MISSION)
    expected = T.inverse()  # where the part's frame lies in the whole one's
    np.testing.assert_allclose(
        together.missions.T_map_mission_of(row).matrix, expected.matrix, atol=1e-9
    )


def test_M5_parts_that_do_not_touch_or_differ_are_refused() -> None:
    whole = line_map(9)
    covariance = whole.edges.covariance.copy()
    covariance[2] *= 2
    other = replace(whole, edges=replace(whole.edges, covariance=covariance))
    at = np.arange(9)
    sparse = whole.select(vertices=(at != 3) & (at < 6))

    with pytest.raises(MapError, match=rf"mission {MISSION} is in two maps that share no vertex"):
        merge([part(whole, 0, 3), part(whole, 5, 8)])
    with pytest.raises(MapError, match="its edges differ where both are"):
        merge([part(whole, 0, 5), other])
    with pytest.raises(MapError, match="their vertices differ"):
        merge([sparse, whole])
