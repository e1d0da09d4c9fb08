"""Rigid motions between points that are the same, and how sure they are."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.operators.objects.loops.alignment_covariance import alignment_covariance
from mapstream.operators.objects.loops.horn import alignments, horn
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import invert, se3_exp, se3_log

_SEEDS = st.integers(0, 10_000)


def _by_svd(a: FloatArray, b: FloatArray, w: FloatArray) -> FloatArray:
    """Return T_a_b by the singular values of the points' spread (Arun 1987, Umeyama 1991)."""
    middle_a, middle_b = w @ a / w.sum(), w @ b / w.sum()
    U, _, Vt = np.linalg.svd((a - middle_a).T @ (w[:, None] * (b - middle_b)))
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, middle_a - R @ middle_b
    return T


def _moved(rng: np.random.Generator, num: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    T_a_b = se3_exp(np.concatenate([rng.uniform(-1.8, 1.8, 3), rng.normal(0, 3, 3)]))
    b = rng.normal(0, 1, (num, 3)) + rng.normal(0, 5, 3)
    return T_a_b, b @ T_a_b[:3, :3].T + T_a_b[:3, 3], b


@given(_SEEDS, st.integers(3, 12), st.sampled_from([0.0, 0.05, 0.3]))
def test_J8_horn_is_the_solution_by_singular_values(seed: int, num: int, noise_m: float) -> None:
    rng = np.random.default_rng(seed)
    T_a_b, a, b = _moved(rng, num)
    a = a + rng.normal(0, noise_m, a.shape) if noise_m else a
    w = rng.uniform(0.2, 3.0, num)
    # where noise makes two motions all but equally good, no method tells them apart to 1e-9
    S = (a - w @ a / w.sum()).T @ (w[:, None] * (b - w @ b / w.sum()))
    sizes = np.linalg.svd(S, compute_uv=False)
    if sizes[1] + np.sign(np.linalg.det(S)) * sizes[2] < 1e-2 * sizes[0]:
        return

    found = horn(a, b, w)

    np.testing.assert_allclose(found, _by_svd(a, b, w), atol=1e-9)
    if not noise_m:
        np.testing.assert_allclose(found, T_a_b, atol=1e-9)


def test_J8_points_on_a_line_or_in_one_place_are_refused() -> None:
    line = np.linspace(0, 2, 5)[:, None] * np.array([1.0, 2.0, -1.0])
    for points in (line, np.ones((4, 3)), line[:2], np.empty((0, 3))):
        with pytest.raises(EstimationError, match="triangle"):
            horn(points, points)


def test_J8_points_in_a_plane_are_enough() -> None:
    rng = np.random.default_rng(0)
    b = np.c_[rng.normal(0, 1, (3, 2)), np.zeros(3)]
    T_a_b = se3_exp(np.array([0.4, -0.2, 2.0, 1.0, 2.0, 3.0]))

    found = horn(b @ T_a_b[:3, :3].T + T_a_b[:3, 3], b)

    np.testing.assert_allclose(found, T_a_b, atol=1e-9)


@pytest.mark.parametrize(("seed", "num"), [(0, 3), (1, 5), (2, 12)])
def test_J10_the_covariance_is_that_of_2000_samples(seed: int, num: int) -> None:
    rng = np.random.default_rng(seed)
    _, a, b = _moved(rng, num)
    b = b + rng.normal(0, 0.05, b.shape)  # points do not fit exactly
    w = rng.uniform(0.5, 2.0, num)
    roots = rng.normal(0, 0.03, (2, num, 3, 3))  # long in some directions
    covariances = roots @ np.swapaxes(roots, 2, 3) + 0.01**2 * np.eye(3)
    chol = np.linalg.cholesky(covariances)
    T_a_b = horn(a, b, w)
    noise = np.einsum("snij,knsj->ksni", chol, rng.normal(size=(2000, num, 2, 3)))

    samples = alignments(a + noise[:, 0], b + noise[:, 1], w)

    sampled = np.cov(se3_log(invert(T_a_b) @ samples).T)
    found = alignment_covariance(T_a_b, a, b, covariances[0], covariances[1], w)
    np.testing.assert_allclose(np.diag(found), np.diag(sampled), rtol=0.2)
    white = np.linalg.inv(np.linalg.cholesky(sampled))
    ratios = np.linalg.eigvalsh(white @ found @ white.T)  # in every direction, correlations too
    assert 0.8 < ratios.min() <= ratios.max() < 1.2


def test_J10_two_points_determine_no_covariance() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    covariances = np.tile(np.eye(3), (3, 1, 1))
    with pytest.raises(EstimationError, match="do not determine"):
        alignment_covariance(np.eye(4), points, points, covariances, covariances)
