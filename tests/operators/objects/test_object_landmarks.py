"""Landmarks of objects: one for each thing, at its place, with its class and extent."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.objects.landmarks.object_landmarks import (
    ObjectLandmarksConfig,
    object_landmarks,
)
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.object_payload import object_payload, payload_bytes
from mapstream.recordings.maps.store import load_map, save_map
from mapstream.streams.geometry import rotation_from_quat_xyzw
from tests.operators.objects.object_worlds import Thing, around, detections, map_of, positions

CUP = Thing("cup", (0.5, 0.3, 0.4), (0.1, 0.1, 0.15))
CHAIR = Thing("chair", (-0.6, 0.2, 0.4), (0.5, 0.4, 0.8), yaw=0.4)
BOOK = Thing("book", (0.1, -0.5, 0.2), (0.3, 0.2, 0.05), yaw=-0.8)
THINGS = [CUP, CHAIR, BOOK]


def seen_twice(
    num: int = 24, *, noise_px: float = 1.0, num_points: int = 0, things: list[Thing] = THINGS
) -> Map:
    """A map in which each thing has one track in the first half of a circle and another in the second."""
    poses = around(num)
    seen = [
        detections(
            T,
            1_000 + n,
            things,
            [i + (100 if n >= num // 2 else 0) for i in range(len(things))],
            noise_px=noise_px,
            num_points=num_points,
        )
        for n, T in enumerate(poses)
    ]
    return map_of(poses, seen)


def by_label(map_: Map) -> dict[str, int]:
    return {label: row for row, label in enumerate(map_.landmarks.label)}


@pytest.mark.parametrize("num_points", [0, 40])
def test_J4_objects_are_triangulated_or_averaged_and_keep_their_class(
    num_points: int, tmp_path: Path
) -> None:
    """Two tracks of each make one landmark within 5 cm, and class, extent and place survive save and load."""
    map_, report = object_landmarks(seen_twice(num_points=num_points))

    assert report.num_objects == len(THINGS)
    assert report.num_joined == len(THINGS)
    rows = by_label(map_)
    for thing in THINGS:
        off_m = np.linalg.norm(positions(map_)[rows[thing.label]] - thing.center)
        assert off_m < 0.05
    assert check_map(map_) == []
    save_map(map_, tmp_path / "map")
    again = load_map(tmp_path / "map")
    assert again.digest() == map_.digest()
    assert set(again.landmarks.label) == {"cup", "chair", "book"}
    assert (again.landmarks.kind == "object").all()


def test_extent_and_orientation_are_those_of_the_thing() -> None:
    """From the points of all views: each side within 2 cm and 8 %, the direction within 5 degrees."""
    map_, report = object_landmarks(seen_twice(num_points=200))

    assert report.num_with_extent == len(THINGS)
    for label, row in by_label(map_).items():
        thing = next(each for each in THINGS if each.label == label)
        known = object_payload(map_.landmarks, row)
        np.testing.assert_allclose(known["extent_m"], thing.extent, atol=0.02, rtol=0.08)
        R = map_.T_map_base(map_.landmarks.vertex[[row]])[0, :3, :3]
        R = R @ rotation_from_quat_xyzw(map_.landmarks.quat_base_xyzw[[row]])[0]
        np.testing.assert_allclose(R[:, 2], [0, 0, 1], atol=1e-9)
        if label != "cup":  # whose sides are alike
            assert abs(np.cos(np.arctan2(R[1, 0], R[0, 0]) - thing.yaw)) > np.cos(np.deg2rad(5))


def test_a_second_call_changes_nothing() -> None:
    """Also where tracks are noisy and some are left over."""
    map_, _ = object_landmarks(seen_twice(noise_px=4.0))

    again, report = object_landmarks(map_)

    assert report.num_joined == 0
    assert again.digest() == map_.digest()


def test_what_is_seen_side_by_side_is_never_one() -> None:
    """Two cups 12 cm apart are two landmarks, though their tracks change half way."""
    cups = [Thing("cup", (x, 0.0, 0.4), (0.1, 0.1, 0.15)) for x in (0.0, 0.12)]

    map_, report = object_landmarks(seen_twice(things=cups))

    assert report.num_objects == 2
    assert np.ptp(positions(map_)[:, 0]) == pytest.approx(0.12, abs=0.03)


def test_a_second_box_around_the_same_thing_is_not_a_second_thing() -> None:
    """A detector that finds a chair twice in each image, a little larger, has found one chair."""
    poses = around(12)
    larger = replace(CHAIR, extent=(0.54, 0.44, 0.84))
    seen = [detections(T, n, [CHAIR, larger], [0, 1]) for n, T in enumerate(poses)]

    map_, report = object_landmarks(map_of(poses, seen))

    assert report.num_objects == 1
    assert len(map_.observations) == 24


def test_boxes_that_the_border_cuts_do_not_pull() -> None:
    """A chair of which most views show a part is within 6 cm; with all boxes alike it is twice as far off."""
    poses = around(20, radius=2.0, turn=2.5)
    poses[6:, :3, 3] -= 1.4 * poses[6:, :3, 0]  # to the left: the left part of the chair is seen
    chair = Thing("chair", (0.0, 0.0, 0.3), (0.6, 0.6, 0.8))
    map_ = map_of(poses, [detections(T, n, [chair], [7]) for n, T in enumerate(poses)])
    alike = replace(map_.observations, sigma=np.full(len(map_.observations), 4.0, np.float32))

    found, _ = object_landmarks(map_)
    worse, _ = object_landmarks(
        replace(map_, observations=alike), ObjectLandmarksConfig(max_error_sigma=1e3)
    )

    assert np.linalg.norm(positions(found)[0] - chair.center) < 0.06
    assert np.linalg.norm(positions(worse)[0] - chair.center) > 0.12


def test_a_track_that_goes_over_to_another_thing_makes_two_landmarks() -> None:
    """The first nine images of it show one book, the last five another one."""
    books = [Thing("book", (x, 0.0, 0.2), (0.3, 0.2, 0.1)) for x in (-0.6, 0.6)]
    poses = around(14, turn=2.0)
    seen = [detections(T, n, [books[n >= 9]], [5]) for n, T in enumerate(poses)]

    map_, report = object_landmarks(map_of(poses, seen))

    assert report.num_objects == 2
    assert np.sort(positions(map_)[:, 0]) == pytest.approx([-0.6, 0.6], abs=0.05)


def test_a_track_without_a_place_joins_the_thing_that_it_points_at() -> None:
    """Four views from one spot do not tell where the cup is, but show the one that the others found."""
    poses = np.concatenate([around(8), around(4, turn=0.01, start=1.0)])
    seen = [detections(T, n, [CUP], [0 if n < 8 else 1]) for n, T in enumerate(poses)]

    map_, report = object_landmarks(map_of(poses, seen))

    assert report.num_objects == 1
    assert (map_.observations.landmark == 0).all()


def test_the_class_is_that_of_most_detections() -> None:
    """Three of ten images call the chair a couch."""
    poses = around(10)
    seen = [detections(T, n, [CHAIR], [0]) for n, T in enumerate(poses)]
    seen = [replace(d, labels=("couch",)) if n % 4 == 1 else d for n, d in enumerate(seen)]

    map_, _ = object_landmarks(map_of(poses, seen))

    assert map_.landmarks.label.tolist() == ["chair"]


def test_what_was_seen_too_rarely_goes_unless_people_named_it() -> None:
    """A landmark with two images left is taken out, and its keypoints stay."""
    map_, _ = object_landmarks(seen_twice())
    row = by_label(map_)["book"]
    of_book = np.flatnonzero(map_.observations.landmark == row)
    landmark = map_.observations.landmark.copy()
    landmark[of_book[2:]] = -1
    track = map_.observations.track.copy()
    track[of_book[2:]] = -1
    seen = replace(map_.observations, landmark=landmark, track=track)
    rare = replace(map_, observations=seen)
    payload = rare.landmarks.payload.copy()
    payload[row] = payload_bytes({"name": "the red book"})
    named = replace(rare, landmarks=replace(rare.landmarks, payload=payload))

    without, report = object_landmarks(rare)
    kept, _ = object_landmarks(named)

    assert sorted(without.landmarks.label) == ["chair", "cup"]
    assert len(without.observations) == len(map_.observations)
    assert report.not_found == {"too few views": 1}
    assert object_payload(kept.landmarks, by_label(kept)["book"])["name"] == "the red book"


def test_texts_are_identities() -> None:
    """Signs at one place with different texts are two; what most detections read is written down."""
    sign = Thing("sign", (0.0, 0.0, 0.4), (0.3, 0.1, 0.2))
    poses = around(16, turn=2.0)
    seen = [detections(T, n, [sign], [0 if n < 8 else 1]) for n, T in enumerate(poses)]
    texts = ["214"] * 7 + ["2l4"] + ["215"] * 8

    one, _ = object_landmarks(map_of(poses, [replace(d, texts=("214",)) for d in seen]))
    two, _ = object_landmarks(
        map_of(poses, [replace(d, texts=(t,)) for d, t in zip(seen, texts, strict=True)])
    )

    assert [json.loads(p)["text"] for p in one.landmarks.payload] == ["214"]
    assert sorted(json.loads(p)["text"] for p in two.landmarks.payload) == ["214", "215"]


def test_a_map_without_detections_stays_as_it_is() -> None:
    """Nothing seen, nothing made."""
    map_, report = object_landmarks(Map.empty())

    assert map_.digest() == Map.empty().digest()
    assert report.num_objects == 0


def test_what_moves_is_no_landmark() -> None:
    """A cart that is pushed through the room while the others stand."""
    poses = around(20)
    seen = []
    for n, T in enumerate(poses):
        cart = Thing("cart", (-0.6 + 0.06 * n, 0.5, 0.3), (0.4, 0.3, 0.6))
        seen.append(detections(T, 100_000_000 * n, [CHAIR, cart], [0, 1], num_points=60))

    map_, report = object_landmarks(map_of(poses, seen))
    all_of_them, _ = object_landmarks(
        map_of(poses, seen), ObjectLandmarksConfig(moving=None, min_share=0.1)
    )

    assert map_.landmarks.label.tolist() == ["chair"]
    assert report.not_found == {"moves": 1}
    assert "cart" in all_of_them.landmarks.label


def test_points_of_a_sensor_without_calibration_are_enough() -> None:
    """Nobody knows how large things look, but where they are."""
    poses = around(12)
    seen = [detections(T, n, [CUP, BOOK], [0, 1], num_points=60) for n, T in enumerate(poses)]

    map_, report = object_landmarks(map_of(poses, [replace(d, camera=None) for d in seen]))

    assert report.num_objects == 2
    assert np.linalg.norm(positions(map_)[by_label(map_)["cup"]] - CUP.center) < 0.05
