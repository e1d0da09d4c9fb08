"""Rigid transforms.

`T_a_b` maps a point of frame b into frame a: `p_a = T_a_b @ p_b`.
Tangent vectors follow gtsam: rotation first, then translation, perturbation on the right.
Functions take leading axes, so one serves a single transform and a batch.
Source: Sola et al., A micro Lie theory for state estimation in robotics, 2018, appendices B and D.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import atan2, hypot
from typing import overload

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
_SMALL_RAD = 1e-8  # below it the series' first term is exact in float64
_EYE = np.eye(3)


def symmetric(matrices: Array) -> Array:
    """Return the symmetric parts of matrices (..., N, N); rounding leaves covariances a little lopsided."""
    return (matrices + np.swapaxes(matrices, -1, -2)) / 2


def hat(w: npt.ArrayLike) -> Array:
    """Return the skew-symmetric matrices (..., 3, 3) of vectors (..., 3)."""
    w = np.asarray(w, dtype=np.float64)
    K = np.zeros((*w.shape, 3))
    K[..., 2, 1], K[..., 0, 2], K[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    K[..., 1, 2], K[..., 2, 0], K[..., 0, 1] = -w[..., 0], -w[..., 1], -w[..., 2]
    return K


def rotation_from_quat_xyzw(quat_xyzw: npt.ArrayLike) -> Array:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4), which need not be normalised.

    Raises:
        ValueError: If a quaternion has no length or is not finite.
    """
    quat = np.asarray(quat_xyzw, dtype=np.float64)
    norm = np.linalg.norm(quat, axis=-1, keepdims=True)
    if not (np.isfinite(norm).all() and (norm > 0).all()):
        raise ValueError(f"quaternion without a direction: {quat.tolist()}")
    quat = quat / norm
    K = hat(quat[..., :3])
    w = quat[..., 3, None, None]
    rotation: Array = np.eye(3) + 2 * w * K + 2 * K @ K
    return rotation


def quat_xyzw_from_rotation(R: npt.ArrayLike) -> Array:
    """Return quaternions (..., 4) of rotation matrices (..., 3, 3), with w >= 0.

    Of the four equal formulas each row takes the best conditioned (Shepperd, 1978).
    """
    R = np.asarray(R, dtype=np.float64)
    trace = np.trace(R, axis1=-2, axis2=-1)
    diagonal = np.diagonal(R, axis1=-2, axis2=-1)
    squares = np.concatenate([1 - trace[..., None] + 2 * diagonal, (1 + trace)[..., None]], axis=-1)
    xx, yy, zz, ww = np.moveaxis(squares, -1, 0)  # four times the square of each component
    xy, xz, yz = (
        R[..., 0, 1] + R[..., 1, 0],
        R[..., 0, 2] + R[..., 2, 0],
        R[..., 1, 2] + R[..., 2, 1],
    )
    xw, yw, zw = (
        R[..., 2, 1] - R[..., 1, 2],
        R[..., 0, 2] - R[..., 2, 0],
        R[..., 1, 0] - R[..., 0, 1],
    )
    rows = [[xx, xy, xz, xw], [xy, yy, yz, yw], [xz, yz, zz, zw], [xw, yw, zw, ww]]
    candidates = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    best = np.argmax(squares, axis=-1)[..., None, None]
    quat = np.take_along_axis(candidates, best, axis=-2)[..., 0, :]
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    positive: Array = np.where(quat[..., 3:] < 0, -quat, quat)
    return positive


def so3_exp(w: npt.ArrayLike) -> Array:
    """Return rotations (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    w = np.asarray(w, dtype=np.float64)
    half = np.linalg.norm(w, axis=-1, keepdims=True) / 2
    scale = np.where(
        half < _SMALL_RAD, 0.5, np.sin(half) / np.where(half < _SMALL_RAD, 1, 2 * half)
    )
    return rotation_from_quat_xyzw(np.concatenate([scale * w, np.cos(half)], axis=-1))


def so3_log(R: npt.ArrayLike) -> Array:
    """Return rotation vectors (..., 3) [rad] of rotations (..., 3, 3), at most pi long."""
    quat = quat_xyzw_from_rotation(R)
    sine = np.linalg.norm(quat[..., :3], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quat[..., 3:])
    scale = np.where(sine < _SMALL_RAD, 2.0, angle / np.where(sine < _SMALL_RAD, 1, sine))
    vector: Array = scale * quat[..., :3]
    return vector


def _left_jacobian(w: Array) -> Array:
    """Return the left Jacobians (..., 3, 3) of SO(3): the V of exp([w, v]) = [exp(w), V v]."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    small = angle < 1e-4  # closed forms lose digits before their series do
    safe = np.where(small, 1, angle)
    a = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    K = hat(w)
    jacobian: Array = np.eye(3) + a * K + b * K @ K
    return jacobian


def se3_exp(xi: npt.ArrayLike) -> Array:
    """Return transforms (..., 4, 4) of tangent vectors (..., 6): rotation [rad], translation [m]."""
    xi = np.asarray(xi, dtype=np.float64)
    w, v = xi[..., :3], xi[..., 3:]
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = so3_exp(w)
    T[..., :3, 3] = (_left_jacobian(w) @ v[..., None])[..., 0]
    T[..., 3, 3] = 1
    return T


def se3_log(T: npt.ArrayLike) -> Array:
    """Return tangent vectors (..., 6) of transforms (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    w = so3_log(T[..., :3, :3])
    v = np.linalg.solve(_left_jacobian(w), T[..., :3, 3, None])[..., 0]
    return np.concatenate([w, v], axis=-1)


def invert(T: npt.ArrayLike) -> Array:
    """Return the inverses of transforms (..., 4, 4)."""
    T = np.asarray(T, dtype=np.float64)
    inverse = np.zeros_like(T)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = Rt
    inverse[..., :3, 3] = -(Rt @ T[..., :3, 3, None])[..., 0]
    inverse[..., 3, 3] = 1
    return inverse


def straightened(T: npt.ArrayLike) -> Array:
    """Return transforms (..., 4, 4) whose rotations are rid of what rounding left in long products.

    One step of Newton's iteration to the nearest rotation: an error of 1e-8 becomes one of 1e-16.
    """
    T = np.array(T, dtype=np.float64)
    R = T[..., :3, :3]
    T[..., :3, :3] = R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R)
    return T


def interpolate(T_a: npt.ArrayLike, T_b: npt.ArrayLike, fraction: npt.ArrayLike) -> Array:
    """Return transforms between T_a (fraction 0) and T_b (1): rotation by slerp, translation linear."""
    T_a, T_b = np.asarray(T_a, dtype=np.float64), np.asarray(T_b, dtype=np.float64)
    fraction = np.asarray(fraction, dtype=np.float64)[..., None]
    R_a, R_b = T_a[..., :3, :3], T_b[..., :3, :3]
    T = np.zeros(np.broadcast_shapes(T_a.shape, T_b.shape, (*fraction.shape[:-1], 1, 1)))
    T[..., :3, :3] = R_a @ so3_exp(fraction * so3_log(np.swapaxes(R_a, -1, -2) @ R_b))
    T[..., :3, 3] = (1 - fraction) * T_a[..., :3, 3] + fraction * T_b[..., :3, 3]
    T[..., 3, 3] = 1
    return T


def _is_mirrored(R: Array) -> bool:
    """Return whether the determinant is negative; written out, since numpy's takes 10 us for one matrix."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    return bool(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0)


@dataclass(frozen=True, slots=True, eq=False)
class SE3:
    """One rigid transform. `matrix` is (4, 4), float64, read-only."""

    matrix: Array

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=np.float64)
        if matrix.shape != (4, 4):
            raise ValueError(f"a transform has shape (4, 4), got {matrix.shape}")
        if not np.isfinite(matrix).all():
            raise ValueError(f"a transform must be finite, got {matrix.tolist()}")
        R = matrix[:3, :3]
        if np.abs(R @ R.T - _EYE).max() > 1e-3 or _is_mirrored(R):  # float32 files round
            raise ValueError(f"not a rotation: {R.tolist()}")
        if matrix[3].tolist() != [0, 0, 0, 1]:
            raise ValueError(f"the last row of a transform is 0 0 0 1, not {matrix[3].tolist()}")
        matrix.flags.writeable = False
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    @cache  # messages carry it by default, and checking a rotation costs 30 us
    def identity(cls) -> SE3:
        return cls(np.eye(4))

    @classmethod
    def from_rotation(cls, R: npt.ArrayLike, t: npt.ArrayLike = (0.0, 0.0, 0.0)) -> SE3:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = R, t
        return cls(matrix)

    @classmethod
    def from_quat_xyzw(cls, quat_xyzw: npt.ArrayLike, t: npt.ArrayLike = (0.0, 0.0, 0.0)) -> SE3:
        return cls.from_rotation(rotation_from_quat_xyzw(quat_xyzw), t)

    @classmethod
    def exp(cls, xi: npt.ArrayLike) -> SE3:
        return cls(se3_exp(xi))

    def log(self) -> Array:
        """Return the tangent vector (6,): rotation [rad], translation [m]."""
        return se3_log(self.matrix)

    @property
    def R(self) -> Array:
        return self.matrix[:3, :3]

    @property
    def t(self) -> Array:
        return self.matrix[:3, 3]

    @property
    def quat_xyzw(self) -> Array:
        return quat_xyzw_from_rotation(self.R)

    @property
    def angle_rad(self) -> float:
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self.R.tolist()
        sine = hypot(zy - yz, xz - zx, yx - xy)  # twice it, as is the cosine
        return atan2(sine, xx + yy + zz - 1)

    def inverse(self) -> SE3:
        return SE3(invert(self.matrix))

    def adjoint(self) -> Array:
        """Return (6, 6) with `self @ exp(xi) == exp(adjoint @ xi) @ self`."""
        adjoint = np.zeros((6, 6))
        adjoint[:3, :3] = adjoint[3:, 3:] = self.R
        adjoint[3:, :3] = hat(self.t) @ self.R
        return adjoint

    def interpolate(self, other: SE3, fraction: float) -> SE3:
        """Return the transform between self (0) and other (1)."""
        return SE3(interpolate(self.matrix, other.matrix, fraction))

    @overload
    def __matmul__(self, other: SE3) -> SE3: ...
    @overload
    def __matmul__(self, other: npt.NDArray[np.floating]) -> Array: ...
    def __matmul__(self, other: SE3 | npt.NDArray[np.floating]) -> SE3 | Array:
        """Compose with a transform, or map points (..., 3)."""
        if isinstance(other, SE3):
            return SE3(self.matrix @ other.matrix)
        points: Array = other @ self.R.T + self.t
        return points

    def __repr__(self) -> str:
        t, quat = np.round(self.t, 4).tolist(), np.round(self.quat_xyzw, 5).tolist()
        return f"SE3(t={t}, quat_xyzw={quat})"
