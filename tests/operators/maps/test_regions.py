"""Rooms and places: they hold points, move with the map, and survive merging, removal and keyframing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from mapstream.operators.estimation.batch import optimize_map
from mapstream.operators.maps.keyframing import KeyframingConfig, keyframe
from mapstream.operators.maps.merge import merge
from mapstream.operators.maps.regions import (
    Region,
    RegionConfig,
    add_region,
    regions_at,
    regions_of,
    remove_region,
)
from mapstream.operators.maps.remove import remove_missions
from mapstream.recordings.maps import Map, check_map, load_map, save_map
from mapstream.recordings.maps.build import add_edges
from mapstream.recordings.maps.combine import merge_maps
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.estimates import RelativePose
from tests.recordings.made_maps import MISSION, OTHER_MISSION, STEP_NS, line_map

KITCHEN = RegionConfig(
    name="kitchen", polygon=((1, -1), (3, -1), (3, 2), (1, 2)), z_m=0, height_m=2.5
)
CORNER = RegionConfig(name="corner", kind="nook", polygon=((2, 1), (3, 1), (3, 2), (2, 2)))
DOOR = RegionConfig(name="door", kind="place", polygon=((3.0, 0.0),))


def named(map_: Map, *configs: RegionConfig) -> Map:
    for config in configs or (KITCHEN, CORNER, DOOR):
        map_, _ = add_region(map_, config)
    return map_


def region(map_: Map, name: str) -> Region:
    return next(each for each in regions_of(map_) if each.name == name)


def test_N10_a_polygon_a_volume_and_a_place_are_labels_of_the_map() -> None:
    map_ = named(line_map(6))

    assert check_map(map_) == []
    regions = regions_of(map_)
    assert [(r.name, r.kind, len(r.corners)) for r in regions] == [
        ("corner", "nook", 4), ("door", "place", 1), ("kitchen", "room", 4),
    ]  # fmt: skip
    np.testing.assert_allclose(region(map_, "kitchen").center, [2, 0.5, 1.25], atol=1e-9)
    assert [r.name for r in regions_at(regions, np.array([2.5, 1.5, 1.0]))] == ["corner", "kitchen"]
    assert [r.name for r in regions_at(regions, np.array([2.5, 1.5, 3.0]))] == ["corner"]
    assert regions_at(regions, np.array([0.5, 0.0, 1.0])) == []


def test_N10_regions_are_saved_with_the_map(tmp_path: Path) -> None:
    folder = tmp_path / "map"
    map_ = named(line_map(3))

    save_map(map_, folder)

    assert load_map(folder).digest() == map_.digest()


@given(st.floats(-3, 3), st.floats(-3, 3), st.integers(3, 9), st.floats(0, 6), st.booleans())
def test_N10_a_regular_polygon_holds_what_is_inside_its_circles(
    x: float,
    y: float,
    num: int,
    start_rad: float,
    is_clockwise: bool,  # noqa: FBT001
) -> None:
    angles = start_rad + np.arange(num) * 2 * np.pi / num * (-1 if is_clockwise else 1)
    corners = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(num)]) * 2.0
    found = Region(name="r", kind="room", corners=corners, height_m=np.nan)
    away = float(np.hypot(x, y))

    holds = found.holds(np.array([x, y, 5.0]))

    if away < 2.0 * np.cos(np.pi / num) - 1e-9:
        assert holds
    if away > 2.0 + 1e-9:
        assert not holds
    np.testing.assert_allclose(found.center, 0, atol=1e-9)


@pytest.mark.parametrize(
    ("polygon", "message"),
    [
        (((0, 0), (1, 1)), "two corners"),
        (((0, 0), (1, 1), (2, 2)), "no area"),
        (((0, 0), (2, 2), (2, 0), (0, 1)), "crosses itself"),
        (((0, 0), (np.nan, 2), (2, 0)), "not finite"),
    ],
)
def test_an_outline_that_is_none_is_refused(
    polygon: tuple[tuple[float, float], ...], message: str
) -> None:
    with pytest.raises(ValidationError, match=message):
        RegionConfig(name="x", polygon=polygon)


def test_a_name_is_given_once_and_taken_away() -> None:
    map_ = named(line_map(3))

    with pytest.raises(MapError, match="there is a room 'kitchen' already"):
        add_region(map_, KITCHEN)
    rest, num = remove_region(map_, "kitchen")
    assert (num, [r.name for r in regions_of(rest)]) == (1, ["corner", "door"])
    with pytest.raises(MapError, match="no region 'cellar'; the map has nook 'corner'"):
        remove_region(map_, "cellar")


def test_N10_a_region_follows_the_map_when_it_bends() -> None:
    """A loop pulls the end of a line of 10 m half a metre aside; the door at its end goes with it."""
    door = RegionConfig(name="door", kind="place", polygon=((9.0, 1.5),))
    map_ = named(line_map(11), KITCHEN, door)
    end = map_.T_map_base(np.array([10]))[0]
    T_0_end = map_.T_map_base(np.array([0]))[0]
    aside = SE3(np.linalg.inv(T_0_end) @ SE3.exp([0, 0, 0, 0, 0.5, 0]).matrix @ end)
    loop = RelativePose(
        kind="loop", mission_a=MISSION, stamp_a_ns=1_000, mission_b=MISSION,
        stamp_b_ns=1_000 + 10 * STEP_NS, T_a_b=aside, covariance=np.eye(6) * 1e-8,
    )  # fmt: skip

    bent, _ = optimize_map(add_edges(map_, [loop]))

    vertex = map_.regions.vertex[map_.regions.name == "door"]
    moved = bent.T_map_base(vertex)[0] @ np.linalg.inv(map_.T_map_base(vertex)[0])
    was, now = region(map_, "door").corners, region(bent, "door").corners
    np.testing.assert_allclose(now, was @ moved[:3, :3].T + moved[:3, 3], atol=1e-6)
    assert np.linalg.norm(now - was) > 0.3
    kitchen_m = region(bent, "kitchen").corners - region(map_, "kitchen").corners
    assert np.linalg.norm(kitchen_m, axis=1).max() < 0.2


def test_regions_stay_where_their_vertex_goes() -> None:
    map_ = named(line_map(9))

    left, _ = keyframe(
        map_,
        KeyframingConfig(every=8, min_common_points=0, min_distance_m=100.0, min_angle_rad=3.0),
    )

    assert check_map(left) == []
    assert len(left.vertices) < len(map_.vertices)
    for name in ("kitchen", "corner", "door"):
        np.testing.assert_allclose(
            region(left, name).corners, region(map_, name).corners, atol=1e-9
        )


def test_N10_regions_go_on_when_maps_are_merged() -> None:
    """Two robots know a kitchen: that of the first map counts; a copy of a map with other rooms still merges."""
    a, b = named(line_map(4), KITCHEN), named(line_map(4, OTHER_MISSION), KITCHEN, DOOR)

    both, _ = merge([a, b])
    again, report = merge([a, named(line_map(4), CORNER)])

    assert check_map(both) == check_map(again) == check_map(merge_maps([a, b])) == []
    assert [r.name for r in regions_of(both)] == ["door", "kitchen"]
    assert both.vertices.mission[both.regions.vertex[both.regions.name == "kitchen"]] == [0]
    assert [r.name for r in regions_of(again)] == ["corner", "kitchen"]
    assert report.repeated == (MISSION,)


def test_regions_outlive_the_mission_that_they_were_fixed_to() -> None:
    both, _ = merge([named(line_map(4), KITCHEN), line_map(4, OTHER_MISSION)])
    known = replace(both.missions, is_base_frame_known=np.ones(2, bool))

    left, _ = remove_missions(replace(both, missions=known), [0])

    assert check_map(left) == []
    np.testing.assert_allclose(
        region(left, "kitchen").corners, region(both, "kitchen").corners, atol=1e-9
    )
