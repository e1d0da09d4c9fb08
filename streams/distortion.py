"""Lens distortion of the normalised image plane, and back, with derivatives.

Every kind is a radius that depends on the radius, r' = f(r), and may have a tangential part:
m' = f(r) n + t(m) with n = m / r, so that dm'/dm = f/r (I - n n^T) + f' n n^T + dt/dm has no pole at r = 0.

A lens is valid where f grows: beyond the first maximum two rays would share a pixel.

Sources: Brown, Decentering Distortion of Lenses, 1966 (radtan); the OpenCV manual, calib3d (rational);
Kannala and Brandt, A Generic Camera Model and Calibration Method, PAMI 2006 (equidistant);
Devernay and Faugeras, Straight Lines Have to Be Straight, 2001 (fov).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import Distortion

BoolArray = npt.NDArray[np.bool_]

_CONVERGED = 1e-10  # of the normalised plane: 1e-7 px at a focal length of 1000 px
_MAX_STEPS = 100
_SMALL_FOV = 1e-4  # [rad]; below it the closed form of the derivative loses digits
_TANGENTIAL = slice(2, 4)  # p1, p2 among the parameters of radtan and rational_polynomial


@dataclass(frozen=True, slots=True, eq=False)
class Distorted:
    """Points of the normalised plane behind the lens, and how they move."""

    points: FloatArray  # (N, 2); NaN where the lens is not valid
    by_point: FloatArray  # (N, 2, 2)
    by_parameter: FloatArray  # (N, 2, P) in the order of `Distortion`


@dataclass(frozen=True, slots=True, eq=False)
class _Radius:
    value: FloatArray  # (N,) f
    slope: FloatArray  # (N,) f'
    by_parameter: FloatArray  # (N, P)


def distort(kind: Distortion, parameters: FloatArray, points: FloatArray) -> Distorted:
    """Bend points (N, 2) of the normalised plane as a lens does."""
    r = np.hypot(points[:, 0], points[:, 1])
    with np.errstate(all="ignore"):  # what is beyond the limit may overflow, and becomes NaN below
        radius = _RADII[kind](r, parameters)
        n = np.where(r[:, None] > 0, points / r[:, None], 0.0)
        scale = np.where(r > 0, radius.value / r, radius.slope)
        radial = (radius.slope - scale)[:, None, None] * (n[:, :, None] * n[:, None, :])
        by_point = scale[:, None, None] * np.eye(2) + radial
        by_parameter = n[:, :, None] * radius.by_parameter[:, None, :]
        bent = scale[:, None] * points
        if _has_tangential(kind):
            p = parameters[_TANGENTIAL]
            shifts, by_shifted = _tangential(points, p)
            bent, by_point = bent + shifts @ p, by_point + by_shifted
            by_parameter[:, :, _TANGENTIAL] = shifts
        valid = (r < limit_radius(kind, parameters)) & (_determinants(by_point) > 0)
    return Distorted(
        points=np.where(valid[:, None], bent, np.nan),
        by_point=np.where(valid[:, None, None], by_point, np.nan),
        by_parameter=np.where(valid[:, None, None], by_parameter, np.nan),
    )


def undistort(kind: Distortion, parameters: FloatArray, points: FloatArray) -> FloatArray:
    """Return the points (N, 2) that a lens bends to `points`; NaN where there are none.

    The radius is found by Newton's method between brackets, then the tangential part by Newton's in 2D.
    """
    if kind == "none":
        return np.array(points)
    r = np.hypot(points[:, 0], points[:, 1])
    found = _undistorted_radius(kind, parameters, r)
    straight = points * np.divide(found, r, out=np.ones_like(r), where=r > 0)[:, None]
    if not _has_tangential(kind) or not parameters[_TANGENTIAL].any():
        return straight
    return _with_tangential(kind, parameters, points, straight)


def limit_radius(kind: Distortion, parameters: FloatArray) -> float:
    """Return the radius on the normalised plane up to which a lens is valid; it may be infinite."""
    return _limit_radius(kind, tuple(parameters.tolist()))


@lru_cache(maxsize=256)
def _limit_radius(kind: Distortion, parameters: tuple[float, ...]) -> float:
    """Find the first pole of f or zero of f', which is a polynomial's first positive root."""
    if kind == "equidistant":
        slope = np.polynomial.Polynomial([1, *(np.array([3, 5, 7, 9]) * parameters)])
        angle = np.sqrt(_first_positive_root(slope))
        return float(np.tan(angle)) if angle < np.pi / 2 else np.inf
    if kind in ("none", "fov"):
        return np.inf
    above, below = map(np.polynomial.Polynomial, _fraction(np.array(parameters)))
    s = np.polynomial.Polynomial([0, 1])  # r squared
    slope = above * below + 2 * s * (above.deriv() * below - above * below.deriv())
    return float(np.sqrt(min(map(_first_positive_root, (slope, below)))))


def _first_positive_root(polynomial: np.polynomial.Polynomial) -> float:
    roots = polynomial.trim().roots()
    real = roots.real[np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots))]
    return float(min(real[real > 0], default=np.inf))


def _undistorted_radius(
    kind: Distortion, parameters: FloatArray, targets: FloatArray
) -> FloatArray:
    """Solve f(r) = target, with r = tan(angle), so that the interval of search is bounded."""
    low = np.zeros_like(targets)
    high = np.full_like(targets, np.arctan(limit_radius(kind, parameters)))
    angle = np.minimum(np.arctan(targets), (low + high) / 2)
    tolerance = 4e-15 * (1 + targets)  # what rounding leaves
    with np.errstate(all="ignore"):  # at the limit the slope may vanish; then the brackets help
        for _ in range(_MAX_STEPS):
            r = np.tan(angle)
            radius = _RADII[kind](r, parameters)
            miss = radius.value - targets
            low, high = np.where(miss < 0, angle, low), np.where(miss < 0, high, angle)
            newton = angle - miss / (radius.slope * (1 + r * r))
            inside = (newton > low) & (newton < high)
            step = np.where(inside, newton, (low + high) / 2) - angle
            settled = ~(np.abs(miss) > tolerance) | (np.abs(step) < 1e-16)
            if settled.all():
                break
            angle = np.where(settled, angle, angle + step)
        solved = np.abs(_RADII[kind](np.tan(angle), parameters).value - targets) < _CONVERGED
    return np.where(solved, np.tan(angle), np.nan)


def _with_tangential(
    kind: Distortion, parameters: FloatArray, targets: FloatArray, start: FloatArray
) -> FloatArray:
    points, missed = start, np.full(len(start), np.inf)
    for _ in range(_MAX_STEPS):
        bent = distort(kind, parameters, points)
        miss = bent.points - targets
        missed = np.abs(miss).max(axis=1)
        if not (missed > 4e-15 * (1 + np.abs(targets).max(axis=1))).any():
            break
        points = points - _solve_2x2(bent.by_point, miss)
    return np.where((missed < _CONVERGED)[:, None], points, np.nan)


def _determinants(A: FloatArray) -> FloatArray:
    determinants: FloatArray = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    return determinants


def _solve_2x2(A: FloatArray, b: FloatArray) -> FloatArray:
    """Solve systems (N, 2, 2) by Cramer's rule; numpy's solver refuses all of them if one is singular."""
    x = A[:, 1, 1] * b[:, 0] - A[:, 0, 1] * b[:, 1]
    y = A[:, 0, 0] * b[:, 1] - A[:, 1, 0] * b[:, 0]
    solved: FloatArray = np.stack([x, y], axis=1) / _determinants(A)[:, None]
    return solved


def _has_tangential(kind: Distortion) -> bool:
    return kind in ("radtan", "rational_polynomial")


def _tangential(points: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the shifts (N, 2, 2) by p1 and p2, and the derivative (N, 2, 2) of their sum by the point."""
    u, v = points.T
    both, square = 2 * u * v, u * u + v * v
    rows = [[both, square + 2 * u * u], [square + 2 * v * v, both]]
    mixed = 2 * (p[0] * u + p[1] * v)
    by_point = [[2 * p[0] * v + 6 * p[1] * u, mixed], [mixed, 6 * p[0] * v + 2 * p[1] * u]]
    return np.moveaxis(np.array(rows), -1, 0), np.moveaxis(np.array(by_point), -1, 0)


def _straight(r: FloatArray, _: FloatArray) -> _Radius:
    return _Radius(r, np.ones_like(r), np.empty((len(r), 0)))


def _fraction(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients (4,) of both polynomials in r^2; radtan's lower one is 1."""
    k = np.concatenate([parameters, np.zeros(8 - len(parameters))])
    return np.array([1, k[0], k[1], k[4]]), np.array([1, k[5], k[6], k[7]])


def _rational(r: FloatArray, parameters: FloatArray) -> _Radius:
    s = r * r
    powers = np.stack([np.ones_like(s), s, s * s, s**3], axis=1)
    slopes = np.stack([np.zeros_like(s), np.ones_like(s), 2 * s, 3 * s * s], axis=1)
    above, below = _fraction(parameters)
    A, B = powers @ above, powers @ below
    slope = A / B + 2 * s * ((slopes @ above) * B - A * (slopes @ below)) / B**2
    by_above, by_below = powers * (r / B)[:, None], -powers * (r * A / B**2)[:, None]
    none = np.zeros_like(r)
    columns = [*by_above[:, 1:3].T, none, none, by_above[:, 3], *by_below[:, 1:].T]
    return _Radius(r * A / B, slope, np.stack(columns[: len(parameters)], axis=1))


def _equidistant(r: FloatArray, parameters: FloatArray) -> _Radius:
    angle = np.arctan(r)
    powers = angle[:, None] ** np.array([1, 3, 5, 7, 9])
    slope = (angle[:, None] ** np.array([0, 2, 4, 6, 8])) @ (
        np.array([1, 3, 5, 7, 9]) * np.array([1, *parameters])
    )
    return _Radius(powers @ np.array([1, *parameters]), slope / (1 + r * r), powers[:, 1:])


def _fov(r: FloatArray, parameters: FloatArray) -> _Radius:
    w = abs(float(parameters[0]))
    if w < _SMALL_FOV:
        bend = r / 12 - r**3 / 3  # the series of f around w = 0
        slope = 1 + w * w * (1 / 12 - r * r)
        return _Radius(r + w * w * bend, slope, (2 * parameters[0] * bend)[:, None])
    t = 2 * np.tan(w / 2)
    value, square = np.arctan(r * t) / w, 1 + (r * t) ** 2
    by_w = r / np.cos(w / 2) ** 2 / square / w - value / w
    return _Radius(value, t / square / w, np.sign(parameters[0]) * by_w[:, None])


_RADII: dict[Distortion, Callable[[FloatArray, FloatArray], _Radius]] = {
    "none": _straight,
    "radtan": _rational,
    "equidistant": _equidistant,
    "fov": _fov,
    "rational_polynomial": _rational,
}
