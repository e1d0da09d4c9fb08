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

from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import Distortion

_CONVERGED = 1e-10  # of the normalised plane: 1e-7 px at a focal length of 1000 px
_MAX_STEPS = 100
_SMALL_FOV = 1e-4  # [rad]; below it the closed form of the derivative loses digits
_TANGENTIAL = slice(2, 4)  # p1, p2 among the parameters of radtan and rational_polynomial


@dataclass(frozen=True, slots=True, eq=False)
class Distorted:
    """Points of the normalised plane behind the lens, and how they move with those before it."""

    points: FloatArray  # (N, 2); NaN where the lens is not valid
    by_point: FloatArray  # (N, 2, 2)


def distort(kind: Distortion, parameters: FloatArray, points: FloatArray) -> Distorted:
    """Bend points (N, 2) of the normalised plane as a lens does."""
    if kind == "none":
        straight = np.broadcast_to(np.eye(2), (len(points), 2, 2))
        return Distorted(np.where(np.isfinite(points), points, np.nan), straight)
    r = np.hypot(points[:, 0], points[:, 1])
    with np.errstate(all="ignore"):  # what is beyond the limit may overflow, and becomes NaN below
        value, slope = _RADII[kind](r, parameters)
        scale = np.where(r > 0, value / r, slope)
        n = _directions(points, r)
        by_point = (slope - scale)[:, None, None] * (n[:, :, None] * n[:, None, :])
        by_point[:, [0, 1], [0, 1]] += scale[:, None]
        bent = scale[:, None] * points
        if _has_tangential(kind):
            p = parameters[_TANGENTIAL]
            bent += _tangential(points) @ p
            by_point += _tangential_by_point(points, p)
        valid = (r < limit_radius(kind, parameters)) & (_determinants(by_point) > 0)
    bent[~valid], by_point[~valid] = np.nan, np.nan
    return Distorted(bent, by_point)


def distortion_by_parameters(
    kind: Distortion, parameters: FloatArray, points: FloatArray
) -> FloatArray:
    """Return how bent points move with the lens' parameters (N, 2, P); rows of invalid points mean nothing."""
    r = np.hypot(points[:, 0], points[:, 1])
    with np.errstate(all="ignore"):
        radius_by_parameter = _RADII_BY_PARAMETER[kind](r, parameters)
        jacobian = _directions(points, r)[:, :, None] * radius_by_parameter[:, None, :]
        if _has_tangential(kind):
            jacobian[:, :, _TANGENTIAL] = _tangential(points)
    return jacobian


def _directions(points: FloatArray, r: FloatArray) -> FloatArray:
    n: FloatArray = points / np.where(r > 0, r, 1.0)[:, None]
    return n


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
            value, slope = _RADII[kind](r, parameters)
            miss = value - targets
            low, high = np.where(miss < 0, angle, low), np.where(miss < 0, high, angle)
            newton = angle - miss / (slope * (1 + r * r))
            inside = (newton > low) & (newton < high)
            step = np.where(inside, newton, (low + high) / 2) - angle
            settled = ~(np.abs(miss) > tolerance) | (np.abs(step) < 1e-16)
            if settled.all():
                break
            angle = np.where(settled, angle, angle + step)
        solved = np.abs(_RADII[kind](np.tan(angle), parameters)[0] - targets) < _CONVERGED
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


def _tangential(points: FloatArray) -> FloatArray:
    """Return the shifts (N, 2, 2) by p1 and p2."""
    u, v = points.T
    shifts = np.empty((len(points), 2, 2))
    shifts[:, 0, 0] = shifts[:, 1, 1] = 2 * u * v
    shifts[:, 0, 1] = 3 * u * u + v * v
    shifts[:, 1, 0] = u * u + 3 * v * v
    return shifts


def _tangential_by_point(points: FloatArray, p: FloatArray) -> FloatArray:
    u, v = points.T
    jacobian = np.empty((len(points), 2, 2))
    jacobian[:, 0, 0] = 2 * p[0] * v + 6 * p[1] * u
    jacobian[:, 0, 1] = jacobian[:, 1, 0] = 2 * (p[0] * u + p[1] * v)
    jacobian[:, 1, 1] = 6 * p[0] * v + 2 * p[1] * u
    return jacobian


def _straight(r: FloatArray, _: FloatArray) -> tuple[FloatArray, FloatArray]:
    return r, np.ones_like(r)


def _straight_by_parameters(r: FloatArray, _: FloatArray) -> FloatArray:
    return np.empty((len(r), 0))


def _fraction(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients (4,) of both polynomials in r^2; radtan's lower one is 1."""
    k = np.concatenate([parameters, np.zeros(8 - len(parameters))])
    return np.array([1, k[0], k[1], k[4]]), np.array([1, k[5], k[6], k[7]])


def _polynomial(coefficients: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a polynomial's values and slopes (N,), by Horner's rule."""
    value, slope = np.zeros_like(s), np.zeros_like(s)
    for coefficient in coefficients[::-1].tolist():
        slope = slope * s + value
        value = value * s + coefficient
    return value, slope


def _rational(r: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
    s = r * r
    above, below = _fraction(parameters)
    A, A_by_s = _polynomial(above, s)
    if len(parameters) < 8:
        return r * A, A + 2 * s * A_by_s
    B, B_by_s = _polynomial(below, s)
    return r * A / B, A / B + 2 * s * (A_by_s * B - A * B_by_s) / B**2


def _rational_by_parameters(r: FloatArray, parameters: FloatArray) -> FloatArray:
    s = r * r
    powers = np.stack([s, s * s, s * s * s], axis=1)
    (A, _), (B, _) = (_polynomial(part, s) for part in _fraction(parameters))
    by_above, by_below = powers * (r / B)[:, None], -powers * (r * A / B**2)[:, None]
    tangential = np.zeros((len(r), 2))
    columns = [by_above[:, :2], tangential, by_above[:, 2:], by_below]
    jacobian: FloatArray = np.concatenate(columns, axis=1)[:, : len(parameters)]
    return jacobian


def _equidistant(r: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
    angle = np.arctan(r)
    value, slope = _polynomial(np.array([1, *parameters]), angle * angle)
    return angle * value, (value + 2 * angle * angle * slope) / (1 + r * r)


def _equidistant_by_parameters(r: FloatArray, _: FloatArray) -> FloatArray:
    angle = np.arctan(r)
    s = angle * angle
    return np.stack([angle * s, angle * s**2, angle * s**3, angle * s**4], axis=1)


def _fov(r: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
    w = abs(float(parameters[0]))
    if w < _SMALL_FOV:  # the series around w = 0
        return r + w * w * (r / 12 - r**3 / 3), 1 + w * w * (1 / 12 - r * r)
    t = 2 * np.tan(w / 2)
    return np.arctan(r * t) / w, t / (1 + (r * t) ** 2) / w


def _fov_by_parameters(r: FloatArray, parameters: FloatArray) -> FloatArray:
    w = float(parameters[0])
    if abs(w) < _SMALL_FOV:
        return (2 * w * (r / 12 - r**3 / 3))[:, None]
    t = 2 * np.tan(w / 2)
    jacobian: FloatArray = r / np.cos(w / 2) ** 2 / (1 + (r * t) ** 2) / w - np.arctan(r * t) / w**2
    return jacobian[:, None]


_RADII: dict[Distortion, Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]] = {
    "none": _straight,
    "radtan": _rational,
    "equidistant": _equidistant,
    "fov": _fov,
    "rational_polynomial": _rational,
}
_RADII_BY_PARAMETER: dict[Distortion, Callable[[FloatArray, FloatArray], FloatArray]] = {
    "none": _straight_by_parameters,
    "radtan": _rational_by_parameters,
    "equidistant": _equidistant_by_parameters,
    "fov": _fov_by_parameters,
    "rational_polynomial": _rational_by_parameters,
}
