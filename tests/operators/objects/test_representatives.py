"""A few descriptors of an object stand for all, one for each side from which it was seen."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapstream.operators.objects.representatives import (
    distances_between,
    mean_silhouette,
    representatives,
)
from mapstream.streams.arrays import Float32Array


def seen_from(num_views: int, per_view: int, spread: float, seed: int) -> Float32Array:
    """Return descriptors (num_views * per_view, 64): views of one object are more alike than chance."""
    rng = np.random.default_rng(seed)
    common = rng.normal(size=64)
    views = common + rng.normal(size=(num_views, 64))
    rows = np.repeat(views, per_view, axis=0)
    rows = rows + spread * rng.normal(size=rows.shape)
    unit: Float32Array = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    return unit


@settings(max_examples=40, deadline=None)
@given(
    num_views=st.integers(1, 7),
    per_view=st.integers(4, 12),
    spread=st.floats(0.05, 0.5),
    seed=st.integers(0, 2**20),
)
def test_J12_as_many_are_found_as_views_were_planted(
    num_views: int, per_view: int, spread: float, seed: int
) -> None:
    found = representatives(seen_from(num_views, per_view, spread, seed))

    assert abs(len(found) - num_views) <= 1
    assert len(set(found // per_view)) >= num_views - 1  # of different views


def test_medoids_are_the_best_there_are() -> None:
    """Of all triples, none leaves 12 descriptors nearer to one of it."""
    descriptors = seen_from(3, 4, 0.4, 5)
    distances = distances_between(descriptors)

    found = representatives(descriptors)

    costs = {
        rows: distances[:, list(rows)].min(axis=1).sum() for rows in combinations(range(12), 3)
    }
    assert tuple(found.tolist()) == min(costs, key=lambda rows: costs[rows])


def test_the_silhouette_is_that_of_the_paper() -> None:
    points = np.array([0.0, 1.0, 5.0, 7.0, 20.0])
    distances = np.abs(points[:, None] - points)

    found = mean_silhouette(distances, np.array([0, 0, 1, 1, 2]))

    by_hand = [1 - 1 / 6, 1 - 1 / 5, 1 - 2 / 4.5, 1 - 2 / 6.5, 0]
    assert found == pytest.approx(np.mean(by_hand))


@pytest.mark.parametrize(
    ("descriptors", "expected"),
    [
        (np.zeros((0, 4)), []),
        (np.full((3, 4), np.nan), []),
        (np.array([[np.nan, 0, 0], [0, 0, 0], [1, 0, 0]]), [2]),
        (np.eye(2), [0]),
        (np.ones((5, 4)) / 2, [0]),
    ],
)
def test_few_or_equal_descriptors(descriptors: np.ndarray, expected: list[int]) -> None:
    assert representatives(descriptors).tolist() == expected


def test_many_descriptors_are_thinned() -> None:
    """2000 of four views: four stand for them, and no square of 2000 is computed."""
    descriptors = seen_from(4, 500, 0.3, 2)

    assert len(set(representatives(descriptors) // 500)) == 4


def test_no_more_than_asked_for() -> None:
    assert len(representatives(seen_from(6, 6, 0.2, 1), max_count=3)) == 3
