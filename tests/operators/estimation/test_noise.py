from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.operators.estimation.noise import noise_from_covariance
from mapstream.streams.errors import EstimationError


@given(st.integers(0, 2**32 - 1), st.sets(st.integers(0, 5), max_size=5))
def test_information_is_the_inverse_and_exactly_zero_where_not_measured(
    seed: int, unmeasured: set[int]
) -> None:
    A = np.random.default_rng(seed).normal(size=(6, 6))
    covariance = A @ A.T + 0.1 * np.eye(6)
    measured = [i for i in range(6) if i not in unmeasured]
    expected = np.zeros((6, 6))
    expected[np.ix_(measured, measured)] = np.linalg.inv(covariance[np.ix_(measured, measured)])
    for i in unmeasured:
        covariance[i, :] = covariance[:, i] = 0
        covariance[i, i] = np.inf

    information = noise_from_covariance(covariance).information()

    np.testing.assert_allclose(information, expected, atol=1e-9 * np.abs(expected).max())
    assert not information[sorted(unmeasured)].any()


def test_diagonal_covariances_stay_diagonal() -> None:
    noise = noise_from_covariance(np.diag([1, 4, np.inf, 9, 16, 25.0]))

    np.testing.assert_allclose(noise.information(), np.diag([1, 1 / 4, 0, 1 / 9, 1 / 16, 1 / 25]))


@pytest.mark.parametrize(
    "wrong", [np.diag([1, 1, 1, 1, 1, -1.0]), np.diag([1, 1, 1, 1, 1, np.nan])]
)
def test_what_is_no_covariance_is_refused(wrong: np.ndarray) -> None:
    with pytest.raises(EstimationError, match="covariance"):
        noise_from_covariance(wrong)
