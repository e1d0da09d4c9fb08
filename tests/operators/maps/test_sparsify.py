"""Fewer landmarks: how many stay, and that every vertex keeps enough."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from mapstream.operators.landmarks.create import create_landmarks
from mapstream.operators.maps.sparsify import SparsifyConfig, sparsify
from mapstream.recordings.maps.check import check_map
from mapstream.recordings.maps.model import Map
from tests.operators.vision_worlds import World


def of_a_drive() -> Map:
    """A map with 300 landmarks, most of which few vertices see."""
    world = World(num_points=300, num_vertices=16, step_s=0.5, seed=3)
    world.points[:, 1] *= 4
    map_ = world.with_odometry(world.map(), noisy=False)
    return create_landmarks(map_)[0]


def landmarks_by_vertex(map_: Map) -> np.ndarray:
    seen = map_.observations
    has = seen.landmark >= 0
    pairs = np.unique(np.stack([seen.vertex[has], seen.landmark[has]]), axis=1)
    return np.bincount(pairs[0], minlength=len(map_.vertices))


@pytest.mark.parametrize("method", ["program", "heuristic", "random"])
def test_M8_the_number_of_landmarks_is_what_was_asked_for(
    method: Literal["program", "heuristic", "random"],
) -> None:
    """By a number or a share; the rest of the map is whole, and the same again is the same."""
    map_ = of_a_drive()

    half, report = sparsify(map_, SparsifyConfig(share=0.5, method=method))
    few, _ = sparsify(map_, SparsifyConfig(num_landmarks=20, method=method))
    again, _ = sparsify(map_, SparsifyConfig(num_landmarks=20, method=method))

    assert len(half.landmarks) == report.num_kept == round(0.5 * len(map_.landmarks))
    assert len(few.landmarks) == 20
    assert few.digest() == again.digest()
    assert len(few.observations) == len(map_.observations)
    assert check_map(few) == []


def test_M8_every_vertex_keeps_what_it_needs() -> None:
    """30 of its landmarks, or all; at random vertices lose more, and the programme keeps more observations than the heuristic."""
    map_ = of_a_drive()
    needed = np.minimum(landmarks_by_vertex(map_), 30)
    share = 0.32

    kept = {
        method: sparsify(map_, SparsifyConfig(share=share, method=method))
        for method in ("program", "heuristic", "random")
    }

    counts = {method: landmarks_by_vertex(found) for method, (found, _) in kept.items()}
    assert (counts["program"] >= needed).all()
    assert kept["program"][1].num_short == 0
    assert kept["random"][1].num_short > 0
    assert kept["heuristic"][1].num_short <= kept["random"][1].num_short
    assert counts["program"].sum() > counts["random"].sum()


def test_M8_large_maps_are_parted() -> None:
    """Along the missions; the parts together have the number, and vertices what they need within one per part."""
    map_ = of_a_drive()
    needed = np.minimum(landmarks_by_vertex(map_), 30)

    left, report = sparsify(map_, SparsifyConfig(share=0.5, max_program=60))

    assert report.num_parts == -(-len(map_.landmarks) // 60)
    assert len(left.landmarks) == round(0.5 * len(map_.landmarks))
    assert (landmarks_by_vertex(left) >= needed - report.num_parts).all()


def test_M8_a_map_without_landmarks_stays() -> None:
    """There is nothing to choose from."""
    map_ = World(num_points=5).map()

    left, report = sparsify(map_)

    assert left is map_
    assert report.num_kept == 0
