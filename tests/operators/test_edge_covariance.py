"""Covariances of sensors as graph files say them, up to the edges of a map."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from mapstream.operators.edge_covariance import PoseCovariance
from mapstream.streams.messages.constraints import Constraint
from tests.operators.estimation.problems import factors_of, with_constraints, with_mission

FULL = np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.03]) + 1e-5


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"sigma_rad": 0.1, "sigma_m": 0.2}, np.diag([0.01] * 3 + [0.04] * 3)),
        ({"sigma_rad": (0.1, 0.2, 0.3), "sigma_m": 1.0}, np.diag([0.01, 0.04, 0.09, 1, 1, 1])),
        ({"sigma_m": (1, 2, 3)}, np.diag([np.inf] * 3 + [1, 4, 9])),
        ({"matrix": FULL.tolist()}, FULL),
    ],
)
def test_F5_a_constant_reaches_every_edge_and_factor(
    given: dict[str, object], expected: np.ndarray
) -> None:
    covariance = PoseCovariance.model_validate(given).constant()
    poses = np.tile(np.eye(4), (3, 1, 1))
    made = [
        Constraint(stamp_ns=1 + k * 500_000_000, kind="absolute", covariance=covariance)
        for k in range(3)
    ]

    map_ = with_constraints(with_mission(poses), made)

    np.testing.assert_allclose(map_.edges.covariance, np.broadcast_to(expected, (3, 6, 6)))
    is_measured = np.isfinite(expected.diagonal())
    information = np.zeros((6, 6))
    information[np.ix_(is_measured, is_measured)] = np.linalg.inv(
        expected[np.ix_(is_measured, is_measured)]
    )
    for factor in factors_of(map_).values():
        root = factor.noiseModel().R()
        np.testing.assert_allclose(root.T @ root, information, rtol=1e-9, atol=1e-9)


def test_F6_the_messages_own_covariance_comes_first() -> None:
    constant = PoseCovariance(sigma_rad=0.1, sigma_m=0.2)

    assert constant.of(FULL) is FULL
    np.testing.assert_array_equal(constant.of(None), constant.constant())


@pytest.mark.parametrize(
    "given",
    [{}, {"sigma_m": 1.0, "matrix": FULL.tolist()}, {"matrix": (-FULL).tolist()}, {"sigma_m": (1, 2)}, {"sigma_rad": -1}],
)  # fmt: skip
def test_F5_what_is_no_covariance_is_refused(given: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        PoseCovariance.model_validate(given)
