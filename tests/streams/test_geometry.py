"""Laws of rigid transforms, and scipy as a second opinion."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation, Slerp

from mapstream.streams.geometry import (
    SE3,
    hat,
    interpolate,
    invert,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
    se3_exp,
    se3_log,
    so3_exp,
    so3_log,
    straightened,
)

Vector = npt.NDArray[np.float64]
MAX_ANGLE_RAD = 3.1  # the logarithm is unique below pi


@st.composite
def tangents(draw: st.DrawFn) -> Vector:
    """Return tangent vectors (6,) of all sizes, tiny angles and nearly half turns among them."""
    direction = draw(arrays(np.float64, 3, elements=st.floats(-1, 1, width=32)))
    norm = np.linalg.norm(direction)
    angle = draw(st.sampled_from([0.0, 1e-12, 1e-8, 1e-5, 1e-3, 3.0]) | st.floats(0, MAX_ANGLE_RAD))
    axis = direction / norm if norm > 1e-3 else np.array([0.0, 0.0, 1.0])
    translation = draw(arrays(np.float64, 3, elements=st.floats(-50, 50, width=32)))
    return np.concatenate([axis * angle, translation])


poses = tangents().map(SE3.exp)


def _close(a: SE3, b: SE3) -> None:
    np.testing.assert_allclose(a.matrix, b.matrix, atol=1e-9)


@given(poses, tangents())
def test_local_undoes_retract(T: SE3, xi: Vector) -> None:
    moved = T @ SE3.exp(xi)

    np.testing.assert_allclose((T.inverse() @ moved).log(), xi, atol=1e-7)


@given(poses, poses)
def test_retract_undoes_local(T: SE3, other: SE3) -> None:
    _close(T @ SE3.exp((T.inverse() @ other).log()), other)


@given(poses, poses, poses)
def test_composition_is_associative_and_inverses_cancel(a: SE3, b: SE3, c: SE3) -> None:
    _close((a @ b) @ c, a @ (b @ c))
    _close(a @ a.inverse(), SE3.identity())
    _close((a @ b).inverse(), b.inverse() @ a.inverse())
    _close(a @ SE3.identity(), a)


@given(poses, poses, arrays(np.float64, (4, 3), elements=st.floats(-9, 9, width=32)))
def test_points_map_as_the_composition_says(a: SE3, b: SE3, points: Vector) -> None:
    np.testing.assert_allclose((a @ b) @ points, a @ (b @ points), atol=1e-9)
    np.testing.assert_allclose(a.inverse() @ (a @ points), points, atol=1e-9)


@given(poses, tangents())
def test_the_adjoint_moves_a_tangent_to_the_other_side(T: SE3, xi: Vector) -> None:
    _close(T @ SE3.exp(xi), SE3.exp(T.adjoint() @ xi) @ T)


@given(tangents())
def test_exp_agrees_with_the_matrix_exponential(xi: Vector) -> None:
    twist = np.zeros((4, 4))
    twist[:3, :3], twist[:3, 3] = hat(xi[:3]), xi[3:]

    np.testing.assert_allclose(se3_exp(xi), expm(twist), atol=1e-9)


@given(tangents())
def test_rotations_agree_with_scipy(xi: Vector) -> None:
    R = so3_exp(xi[:3])
    scipy = Rotation.from_rotvec(xi[:3])

    np.testing.assert_allclose(R, scipy.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(so3_log(R), scipy.as_rotvec(), atol=1e-7)
    np.testing.assert_allclose(
        quat_xyzw_from_rotation(R), scipy.as_quat(canonical=True), atol=1e-12
    )


@given(arrays(np.float64, 4, elements=st.floats(-1, 1, width=32)), st.floats(0.1, 10))
def test_quaternions_need_not_be_normalised(quat_xyzw: Vector, scale: float) -> None:
    if np.linalg.norm(quat_xyzw) < 1e-3:
        return
    R = rotation_from_quat_xyzw(scale * quat_xyzw)

    np.testing.assert_allclose(R, Rotation.from_quat(quat_xyzw).as_matrix(), atol=1e-9)
    back = SE3.from_rotation(R).quat_xyzw
    assert back[3] >= 0
    np.testing.assert_allclose(rotation_from_quat_xyzw(back), R, atol=1e-9)


@pytest.mark.parametrize("axis", [*np.eye(3).tolist(), [0.6, 0.8, 0], [1 / 3, 2 / 3, 2 / 3]])
def test_half_turns_have_a_logarithm(axis: list[float]) -> None:
    R = so3_exp(np.pi * np.array(axis))

    w = so3_log(R)

    assert np.linalg.norm(w) == pytest.approx(np.pi)
    np.testing.assert_allclose(so3_exp(w), R, atol=1e-9)


@given(poses, poses, st.floats(0, 1))
def test_interpolation_is_slerp_and_linear_with_exact_ends(a: SE3, b: SE3, fraction: float) -> None:
    middle = a.interpolate(b, fraction)

    relative = (a.inverse() @ b).angle_rad
    if relative < MAX_ANGLE_RAD:  # of a half turn either way is right
        slerp = Slerp([0, 1], Rotation.from_matrix(np.stack([a.R, b.R])))
        np.testing.assert_allclose(middle.R, slerp(fraction).as_matrix(), atol=1e-7)
    np.testing.assert_allclose(middle.t, (1 - fraction) * a.t + fraction * b.t, atol=1e-9)
    _close(a.interpolate(b, 0.0), a)
    _close(a.interpolate(b, 1.0), b)


@pytest.mark.parametrize("function", [se3_exp, lambda xi: se3_log(se3_exp(xi)), hat])
def test_batches_equal_one_by_one(function: Callable[[Vector], Vector]) -> None:
    rng = np.random.default_rng(0)
    batch = rng.normal(size=(2, 5, 3 if function is hat else 6))

    one_by_one = np.stack([np.stack([function(v) for v in row]) for row in batch])

    np.testing.assert_allclose(function(batch), one_by_one, atol=1e-12)


def test_batches_of_transforms_invert_and_interpolate() -> None:
    rng = np.random.default_rng(0)
    a, b = se3_exp(rng.normal(size=(2, 7, 6)))

    np.testing.assert_allclose(invert(a) @ a, np.tile(np.eye(4), (7, 1, 1)), atol=1e-12)
    middle = interpolate(a, b, np.linspace(0, 1, 7))
    np.testing.assert_allclose(middle[[0, 6]], np.stack([a[0], b[6]]), atol=1e-9)
    np.testing.assert_allclose(interpolate(a[0], b[0], 0.3), interpolate(a[:1], b[:1], 0.3)[0])


def test_a_transform_keeps_its_numbers_to_itself() -> None:
    matrix = np.eye(4)
    T = SE3(matrix)
    matrix[0, 3] = 9

    assert T.t[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        T.t[0] = 1


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), r"has shape \(4, 4\), got \(3, 3\)"),
        (np.diag([1, 1, np.nan, 1]), "must be finite"),
        (np.diag([2.0, 1, 1, 1]), "not a rotation"),
        (np.diag([1.0, 1, -1, 1]), "not a rotation"),
        (np.diag([1.0, 1, 1, 2]), "last row"),
    ],
)
def test_what_is_no_transform_is_refused(matrix: Vector, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SE3(matrix)


@pytest.mark.parametrize("quat_xyzw", [[0, 0, 0, 0], [0, 0, 0, np.nan]])
def test_a_quaternion_without_direction_is_refused(quat_xyzw: list[float]) -> None:
    with pytest.raises(ValueError, match="without a direction"):
        SE3.from_quat_xyzw(quat_xyzw)


def test_a_transform_shows_itself_shortly() -> None:
    assert repr(SE3.exp([0, 0, 0, 1, 2, 3])) == (
        "SE3(t=[1.0, 2.0, 3.0], quat_xyzw=[0.0, 0.0, 0.0, 1.0])"
    )


def test_a_product_of_many_rotations_is_straightened() -> None:
    rng = np.random.default_rng(0)
    T = se3_exp(rng.normal(size=(5, 6)))
    bent = T.copy()
    bent[:, :3, :3] += rng.normal(size=(5, 3, 3)) * 1e-8

    straight = straightened(bent)

    R = straight[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(straight, T, atol=1e-7)
    np.testing.assert_array_equal(straight[:, :3, 3], bent[:, :3, 3])
