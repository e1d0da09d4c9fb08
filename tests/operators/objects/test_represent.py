"""Detections that stand for all of their object are marked in the map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapstream.operators.landmarks.create import create_landmarks
from mapstream.operators.maps.steps import TOOLS, loaded
from mapstream.operators.objects.represent import RepresentObjectsConfig, represent_objects
from mapstream.recordings.maps import Map, check_map, load_map, save_map
from tests.operators.objects.object_worlds import Thing, around, detections, map_of

CUP = Thing("cup", (0.5, 0.3, 0.4), (0.1, 0.1, 0.15))
BOOK = Thing("book", (0.1, -0.5, 0.2), (0.3, 0.2, 0.05), yaw=-0.8)
NUM, SIDES = 32, (4, 2)  # of which the two look different


def seen_from_all_sides(num: int = NUM) -> Map:
    """A cup that looks different from each of four sides, and a book of two."""
    rng = np.random.default_rng(4)
    sides = rng.normal(size=(2, 4, 24))
    seen = []
    for n, T in enumerate(around(num)):
        found = detections(T, 1_000 + n, [CUP, BOOK], [0, 1])
        rows = np.array([sides[k, n * SIDES[k] // num] for k in range(2)])
        rows = rows[: len(found)] + 0.2 * rng.normal(size=(len(found), 24))
        looks = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        seen.append(replace(found, descriptors=looks.astype(np.float32)))
    return create_landmarks(map_of(around(num), seen))[0]


def test_J12_each_object_keeps_as_many_descriptors_as_it_has_sides(tmp_path: Path) -> None:
    map_, report = represent_objects(seen_from_all_sides())

    table, seen = map_.detections, map_.observations
    landmark = seen.landmark[table.observation]
    labels = map_.landmarks.label.tolist()
    counts = [
        table.is_representative[landmark == labels.index(name)].sum() for name in ("cup", "book")
    ]
    assert np.abs(np.array(counts) - SIDES).max() <= 1
    assert report.num_objects == 2
    assert report.num_descriptors == 2 * NUM
    assert report.num_representatives == sum(counts)
    assert check_map(map_) == []
    save_map(map_, tmp_path / "map")
    assert load_map(tmp_path / "map").digest() == map_.digest()
    assert represent_objects(map_)[0].digest() == map_.digest()


def test_no_more_than_asked_for() -> None:
    _, report = represent_objects(seen_from_all_sides(), RepresentObjectsConfig(max_per_object=1))

    assert report.num_representatives == 2


@pytest.mark.parametrize("map_", [Map.empty(), map_of(around(2), [detections(T, n, [CUP], [0]) for n, T in enumerate(around(2))])])  # fmt: skip
def test_maps_without_described_objects_stay_as_they_are(map_: Map) -> None:
    same, report = represent_objects(map_)

    assert same.digest() == map_.digest()
    assert report.num_objects == 0


def test_it_is_a_tool() -> None:
    assert "represent_objects" in TOOLS
    assert loaded("represent_objects") == (represent_objects, RepresentObjectsConfig)
