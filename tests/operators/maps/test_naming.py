"""Names by hand, and where what is called so is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.landmarks.merging import merge_landmarks
from mapstream.operators.landmarks.removal import remove_bad_landmarks, remove_invalid_observations
from mapstream.operators.maps.naming import find_landmark, name_landmark
from mapstream.operators.maps.regions import RegionConfig, add_region
from mapstream.operators.maps.sparsify import SparsifyConfig, sparsify
from mapstream.operators.maps.where import where
from mapstream.operators.maps.words import matches
from mapstream.recordings.maps import Map, check_map
from mapstream.recordings.maps.constraints import add_constraints
from mapstream.recordings.maps.hulls import hull_of, hull_payload
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.object_payload import object_payload, payload_bytes
from mapstream.recordings.maps.rows import concatenate
from mapstream.recordings.maps.tables import Landmarks, Observations
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.constraints import Constraint, LandmarkRef
from tests.recordings.made_maps import MISSION, line_map

SQUARE = np.array([[-0.5, -0.4], [0.5, -0.4], [0.5, 0.4], [-0.5, 0.4]])
CUP, OTHER_CUP, CUPBOARD, TABLE = range(4)


def table_seen(x: float, stamp_ns: int = 1_000) -> Constraint:
    return Constraint(
        stamp_ns=stamp_ns,
        kind="plane",
        T_a_b=SE3.from_rotation(np.eye(3), [x, 1.0, 0.7]),
        covariance=np.diag([1e-4, 1e-4, np.inf, np.inf, np.inf, 1e-4]),
        landmark=LandmarkRef(name="table", kind="plane"),
        payload=hull_payload(SQUARE),
    )


def furnished() -> Map:
    """Two cups and a cupboard at the robot's first pose, and a table of which it sees half."""
    map_ = line_map(4)
    labels = ["cup", "cup", "cupboard"]
    things = Landmarks(
        id=id_array(derived_id("thing", number) for number in range(3)),
        kind=np.array(["object"] * 3, dtype=object),
        label=np.array(labels, dtype=object),
        vertex=np.zeros(3, np.int64),
        p_base=np.array([[1.0, 1.0, 0.8], [3.0, 0.0, 0.8], [5.0, 0.0, 1.0]]),
        payload=np.array([payload_bytes({"extent_m": [0.1, 0.1, 0.12]}), b"", b""], dtype=object),
    )
    map_ = replace(map_, landmarks=concatenate([map_.landmarks, things]))
    return add_constraints(map_, MISSION, [table_seen(1.0)])


def test_N9_a_name_is_kept_with_what_is_known_of_an_object() -> None:
    map_, naming = name_landmark(furnished(), CUP, "my cup")

    assert check_map(map_) == []
    assert (naming.name, naming.was, naming.label) == ("my cup", "", "cup")
    assert object_payload(map_.landmarks, CUP) == {"extent_m": [0.1, 0.1, 0.12], "name": "my cup"}
    again, naming = name_landmark(map_, CUP, "")
    assert (naming.name, naming.was) == ("", "my cup")
    assert object_payload(again.landmarks, CUP) == {"extent_m": [0.1, 0.1, 0.12]}


def test_N9_a_plane_keeps_its_name_as_its_outline_grows() -> None:
    map_, _ = name_landmark(furnished(), TABLE, "kitchen table")

    grown = add_constraints(map_, MISSION, [table_seen(1.5)])

    assert check_map(grown) == []
    assert object_payload(grown.landmarks, TABLE)["name"] == "kitchen table"
    assert np.ptp(hull_of(grown.landmarks.payload[TABLE]), axis=0) == pytest.approx([1.5, 0.8])


def test_N9_of_two_that_are_one_the_name_stays() -> None:
    map_, _ = name_landmark(furnished(), OTHER_CUP, "my cup")

    merged, _ = merge_landmarks(map_, np.array([[CUP, OTHER_CUP]]))

    (found,) = where(merged, "my cup")
    assert found.position == pytest.approx([1.0, 1.0, 0.8])
    assert found.extent_m == pytest.approx([0.1, 0.1, 0.12])


def seen_landmarks() -> Map:
    """All landmarks were seen once, without a camera; they are bad, and are 9 m from where they were seen."""
    map_, _ = name_landmark(furnished(), CUP, "my cup")
    num = len(map_.landmarks)
    observations = Observations(
        vertex=np.zeros(num, np.int64),
        landmark=np.arange(num),
        sensor=np.array(["camera"] * num, dtype=object),
        p_sensor=np.full((num, 3), 9.0, np.float32),
    )
    landmarks = replace(map_.landmarks, quality=np.array(["bad"] * num, dtype=object))
    return replace(map_, landmarks=landmarks, observations=observations)


def test_N9_what_people_named_is_not_removed() -> None:
    """By quality all would go, by false observations all to which no edge leads, as one does to the table."""
    map_ = seen_landmarks()

    by_quality, _ = remove_bad_landmarks(map_)
    by_sight, _ = remove_invalid_observations(map_)

    assert [thing.name for thing in where(by_quality, "*")] == ["my cup"]
    assert sorted(thing.label or thing.kind for thing in where(by_sight, "*")) == ["cup", "plane"]


def test_things_stay_in_a_sparse_map() -> None:
    map_ = seen_landmarks()

    sparse, report = sparsify(map_, SparsifyConfig(num_landmarks=1))

    assert report.num_before == 0
    assert len(sparse.landmarks) == len(map_.landmarks)


@pytest.mark.parametrize(
    ("text", "near", "expected"),
    [
        ("cup", (2.8, 0, 0.8), OTHER_CUP),
        ("cupboard", None, CUPBOARD),
        ("", (1.4, 1.2, 0.75), TABLE),  # above its edge; the cup is further away than that
        ("", (1.0, 1.0, 0.82), CUP),
        ("plane", None, TABLE),
    ],
)
def test_N9_a_landmark_is_chosen_by_class_and_place(
    text: str, near: tuple[float, ...] | None, expected: int
) -> None:
    map_ = furnished()

    assert find_landmark(map_, text, None if near is None else np.array(near)) == expected


def test_N9_a_landmark_is_chosen_by_its_id() -> None:
    map_ = furnished()
    digits = bytes(map_.landmarks.id[OTHER_CUP]).hex()

    assert find_landmark(map_, digits[:8]) == OTHER_CUP


@pytest.mark.parametrize(
    ("text", "near", "message"),
    [
        ("cup", None, "2 landmarks are called 'cup': say near which x,y,z"),
        ("sofa", None, "no landmark is called 'sofa'; the map has cup, cupboard, plane"),
        ("cup", (9.0, 9.0, 9.0), "no cup within 1 m of .* the nearest is"),
    ],
)
def test_what_is_not_one_landmark_is_refused(
    text: str, near: tuple[float, ...] | None, message: str
) -> None:
    with pytest.raises(MapError, match=message):
        find_landmark(furnished(), text, None if near is None else np.array(near))


def test_N9_where_tells_pose_size_and_region() -> None:
    kitchen = RegionConfig(name="kitchen", polygon=((0, 0.5), (4, 0.5), (4, 2), (0, 2)))
    map_, _ = add_region(furnished(), kitchen)
    map_, _ = name_landmark(map_, TABLE, "kitchen table")

    (table,) = where(map_, "Kitchen TABLE")
    cups = where(map_, "cup")
    everything = where(map_, "kitchen")

    assert table.position == pytest.approx([1.0, 1.0, 0.7])
    assert table.quat_xyzw == pytest.approx([0, 0, 0, 1])
    assert table.extent_m == pytest.approx([1.0, 0.8, 0.0])
    assert (table.regions, table.num_observations) == (("kitchen",), 1)
    assert sorted((cup.label, cup.regions) for cup in cups) == [("cup", ()), ("cup", ("kitchen",))]
    assert sorted(each.name for each in everything) == ["kitchen", "kitchen table"]
    nearest = where(map_, "cup", np.array([3.1, 0.0, 0.8]))
    assert nearest[0].distance_m == pytest.approx(0.1)
    assert where(map_, "sofa") == []


@pytest.mark.parametrize(
    ("text", "name", "expected"),
    [
        ("table", "kitchen table", True),
        ("TABLE kitchen", "Kitchen table", True),
        ("cup", "cupboard", False),
        ("cup*", "cupboard", True),
        ("exit 12", "EXIT 12", True),
        ("dining table", "dining_table", True),
        ("", "cup", False),
    ],
)
def test_words_match_in_any_case_and_as_a_whole(text: str, name: str, expected: bool) -> None:  # noqa: FBT001
    assert matches(text, (name,)) == expected
