"""Quantiles of durations without keeping them."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mapstream.operators.durations import Durations

_CALLS = st.lists(st.integers(min_value=1, max_value=10**12), min_size=1, max_size=200)


def counted(values: list[int]) -> Durations:
    durations = Durations()
    for value in values:
        durations.add(value)
    return durations


@given(values=_CALLS, fraction=st.sampled_from([0.5, 0.95, 0.99, 1.0]))
def test_a_quantile_is_within_a_bin_of_the_exact_one(values: list[int], fraction: float) -> None:
    """Bins are 9 % wide, and their middle is taken."""
    exact = np.quantile(values, fraction, method="inverted_cdf")

    assert math.isclose(counted(values).quantile_ns(fraction), exact, rel_tol=0.05)


def test_without_calls_there_is_no_quantile() -> None:
    assert math.isnan(Durations().quantile_ns(0.5))
