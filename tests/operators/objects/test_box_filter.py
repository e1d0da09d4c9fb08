"""The filter of boxes is Kalman's, and its parts are what the paper says."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.operators.objects.tracking.box_filter import (
    BoxFilter,
    BoxNoise,
    corners_of,
    shapes_of,
)
from mapstream.operators.objects.tracking.gallery import Gallery
from mapstream.operators.objects.tracking.matching import assigned, cascaded, overlaps

BOXES = np.array([[10.0, 20, 50, 100], [300, 200, 420, 260], [0, 0, 9, 7]])
SEEDS = st.integers(0, 2**20)


def test_it_is_a_kalman_filter_of_eight_states() -> None:
    """The four filters of two states equal one of eight, written as in the textbook, over steps of different length."""
    noise, rng = BoxNoise(), np.random.default_rng(3)
    filter_ = BoxFilter(noise, width_px=640)
    shapes = shapes_of(BOXES)
    states = filter_.begun(shapes)
    row = 1
    mean = np.append(shapes[row], np.zeros(4))
    covariance = np.diag(np.append(states.variance[row], states.rate_variance[row]))
    for dt_s in (0.03, 0.1, 0.5):
        walk = np.append(
            [(noise.speed_change * 640) ** 2] * 2, (noise.growth_change * mean[2:4]) ** 2
        )
        F = np.eye(8) + dt_s * np.eye(8, k=4)
        parts = np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]])
        mean, covariance = F @ mean, F @ covariance @ F.T + np.kron(parts, np.diag(walk))
        states = filter_.predicted(states, dt_s)
        R = np.diag(filter_.begun(mean[None, :4]).variance[0])
        z = shapes + rng.normal(size=shapes.shape) * [3, 3, 0.02, 3]
        S = covariance[:4, :4] + R
        away = z[row] - mean[:4]
        assert filter_.distances(states, z)[row, row] == pytest.approx(
            away @ np.linalg.solve(S, away)
        )
        K = covariance[:, :4] @ np.linalg.inv(S)
        mean, covariance = mean + K @ away, covariance - K @ S @ K.T
        states = filter_.corrected(states, np.arange(3), z)

    np.testing.assert_allclose(np.append(states.mean[row], states.rate[row]), mean, rtol=1e-9)
    np.testing.assert_allclose(states.variance[row], np.diag(covariance)[:4], rtol=1e-9)
    np.testing.assert_allclose(states.covariance[row], np.diag(covariance, 4), rtol=1e-9)
    np.testing.assert_allclose(states.rate_variance[row], np.diag(covariance)[4:], rtol=1e-9)


def test_shapes_and_corners_are_inverse() -> None:
    np.testing.assert_allclose(corners_of(shapes_of(BOXES)), BOXES)


def test_overlaps() -> None:
    found = overlaps(
        np.array([[0.0, 0, 4, 4]]), np.array([[2.0, 0, 6, 4], [5, 5, 6, 6], [0, 0, 4, 4]])
    )

    np.testing.assert_allclose(found, [[8 / 24, 0, 1]])


@given(SEEDS, st.integers(1, 5), st.integers(1, 5))
def test_assigned_pairs_are_as_many_and_as_cheap_as_can_be(
    seed: int, rows: int, columns: int
) -> None:
    rng = np.random.default_rng(seed)
    costs = np.where(rng.random((rows, columns)) < 0.6, rng.random((rows, columns)), np.inf)

    pairs = assigned(costs)

    square = np.full((5, 5), np.inf)
    square[:rows, :columns] = costs
    totals = []
    for order in permutations(range(5)):
        chosen = square[np.arange(5), list(order)]
        finite = chosen[np.isfinite(chosen)]
        totals.append((-len(finite), finite.sum()))
    best = min(totals)
    assert (-len(pairs), pytest.approx(costs[pairs[:, 0], pairs[:, 1]].sum())) == best


def test_tracks_seen_later_choose_first() -> None:
    costs = np.array([[0.1, 0.2], [0.5, np.inf]])

    assert cascaded(costs, np.array([1, 2])).tolist() == [[1, 0], [0, 1]]
    assert cascaded(costs, np.array([2, 1])).tolist() == [[0, 0]]


def test_a_gallery_keeps_the_last_and_finds_the_most_alike() -> None:
    gallery = Gallery(3)
    rows = np.eye(5, dtype=np.float32)
    before = gallery.distances(rows)
    gallery.add(np.full(5, np.nan, np.float32))
    for row in rows[:4]:
        gallery.add(row)

    assert np.isnan(before).all()
    assert gallery.distances(rows).tolist() == [1, 0, 0, 0, 1]
