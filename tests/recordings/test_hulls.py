"""Outlines of planes: what two of them have in common."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.recordings.maps.hulls import area_of, common_area_of, convex_hull

WALL = np.array([[0.914, 0.519], [-0.389, 0.801], [-0.412, 0.793], [-0.411, -0.48], [0.664, -0.914], [0.914, 0.288]])  # fmt: skip
AGAIN = np.array([[0.909, 0.518], [-0.411, 0.794], [-0.41, -0.48], [0.661, -0.913], [0.909, 0.287]])
SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])


def test_N3_an_outline_seen_twice_is_common_to_both() -> None:
    """Half a second later corners lie some millimetres off; cv2.intersectConvexConvex finds nothing in common here."""
    assert common_area_of(WALL, AGAIN) == pytest.approx(area_of(AGAIN), rel=0.01)


@given(st.integers(0, 10**6), st.integers(3, 12))
def test_an_outline_lies_on_itself_shifted_by_a_millimetre(seed: int, corners: int) -> None:
    rng = np.random.default_rng(seed)
    hull = convex_hull(rng.uniform(-1, 1, (corners + 3, 2)))
    moved = hull + rng.normal(0, 1e-3, 2)

    common = common_area_of(hull, moved)

    assert common == pytest.approx(common_area_of(moved, hull), abs=1e-9)
    assert 0 <= common <= area_of(hull) + 1e-9
    assert area_of(hull) - common < 0.03


@pytest.mark.parametrize(
    ("shift", "area"),
    [((0.25, 0.0), 0.75), ((0.5, 0.5), 0.25), ((1.0, 0.0), 0.0), ((0, -3), 0.0), ((0, 0), 1.0)],
)
def test_N3_squares_in_common(shift: tuple[float, float], area: float) -> None:
    assert common_area_of(SQUARE, SQUARE + shift) == pytest.approx(area)
    assert common_area_of(SQUARE, (SQUARE + shift)[::-1]) == pytest.approx(area)  # clockwise
    assert common_area_of(SQUARE, np.array([[0.2, 0.2], [0.8, 0.8]])) == 0.0  # a line
    assert common_area_of(SQUARE, np.empty((0, 2))) == 0.0
