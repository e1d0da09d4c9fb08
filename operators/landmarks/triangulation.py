"""Points from rays of many views, all points at once.

The start is the point nearest to all rays in the sense of least squares; Gauss-Newton on angles follows,
under the Cauchy loss so that a false match in a track does not pull.
Sources: Hartley and Zisserman, Multiple View Geometry, 2004, chapter 12; Zhang, Parameter estimation techniques, IVC 1997.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import BoolArray, FloatArray, IntArray

_ITERATIONS = 15
_CONVERGED = 1e-10  # of the distance
_CAUCHY = 2.385  # standard deviations, 95 % efficient without outliers
_TINY = 1e-12
_SWEEPS = 3  # to the farthest of all rays; two are exact where observers lie on a curve


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Triangulated points, by group."""

    positions: FloatArray  # (G, 3) [m]; NaN where rays are parallel
    covariance: FloatArray  # (G, 3, 3) [m^2]
    parallax_rad: FloatArray  # (G,) the largest angle between two rays at the point
    errors_rad: FloatArray  # (N,) of each ray against its point
    is_in_front: BoolArray  # (N,)


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Rays in order of their groups, which are numbered from 0."""

    group: IntArray  # (N,) not decreasing
    origins: FloatArray  # (N, 3) [m]
    directions: FloatArray  # (N, 3) unit
    sigmas_rad: FloatArray  # (N,)

    @property
    def num_groups(self) -> int:
        return int(self.group[-1]) + 1 if len(self.group) else 0


def triangulate(rays: Rays) -> Points:
    """Return the point that each group of rays meets in; every group has at least one ray."""
    if not len(rays.group):
        empty = np.zeros(0)
        return Points(np.zeros((0, 3)), np.zeros((0, 3, 3)), empty, empty, empty.astype(bool))
    center = group_sums(rays.group, rays.origins) / group_sums(rays.group, np.ones((len(rays.group), 1)))  # fmt: skip
    local = rays.origins - center[rays.group]  # far from the map's origin digits would be lost
    positions = _nearest_to_all(rays, local)
    information = np.zeros((rays.num_groups, 3, 3))
    for _ in range(_ITERATIONS):
        information, gradient, reach_m = _normal_equations(rays, local, positions)
        step = -_solved(information, gradient)
        length = np.linalg.norm(step, axis=1)
        capped = np.minimum(1, 0.5 * reach_m / np.maximum(length, _TINY))  # far points overshoot
        positions = positions + step * capped[:, None]
        if not np.nanmax(length / np.maximum(reach_m, _TINY), initial=0) > _CONVERGED:
            break
    away = positions[rays.group] - local
    distance = np.linalg.norm(away, axis=1)
    cosine = np.einsum("ni,ni->n", away, rays.directions) / np.maximum(distance, _TINY)
    sine = np.linalg.norm(np.cross(away, rays.directions), axis=1) / np.maximum(distance, _TINY)
    return Points(
        positions=positions + center,
        covariance=_inverse(information),
        parallax_rad=widest_angles(rays.group, away),
        errors_rad=np.arctan2(sine, cosine),
        is_in_front=cosine > 0,
    )


def group_sums(group: IntArray, values: FloatArray) -> FloatArray:
    """Return the sums (G, ...) of values (N, ...) of groups that come in order, none of them empty."""
    starts = np.flatnonzero(np.append(True, group[1:] != group[:-1]))
    sums: FloatArray = np.add.reduceat(values, starts, axis=0)
    return sums


def widest_angles(group: IntArray, away: FloatArray) -> FloatArray:
    """Return the largest angle (G,) [rad] between two directions (N, 3) of a group.

    From one direction to the one farthest from it, and from there again: exact where they lie on a curve.
    """
    n = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), _TINY)
    starts = np.flatnonzero(np.append(True, group[1:] != group[:-1]))
    far, widest = n[starts], np.zeros(len(starts))
    for _ in range(_SWEEPS):
        apart = np.linalg.norm(n - far[group], axis=1)
        order = np.lexsort((apart, group))
        last = order[np.append(starts[1:], len(group)) - 1]
        far, chord = n[last], apart[last]
        widest = np.fmax(widest, 2 * np.arcsin(np.minimum(chord / 2, 1)))
    return widest


def _nearest_to_all(rays: Rays, local: FloatArray) -> FloatArray:
    """Return the points (G, 3) with the least sum of squared distances from the rays."""
    d = rays.directions
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    normal = group_sums(rays.group, across)
    right = group_sums(rays.group, np.einsum("nij,nj->ni", across, local))
    return _solved(normal, right)


def _normal_equations(
    rays: Rays, local: FloatArray, positions: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return information (G, 3, 3), gradient (G, 3) and the mean distance (G,) of points from their observers.

    The error of a ray is d x n, for its direction d and the unit vector n to the point: the sine of the angle.
    """
    away = positions[rays.group] - local
    distance = np.maximum(np.linalg.norm(away, axis=1), _TINY)
    n = away / distance[:, None]
    d = rays.directions
    error = n - d * np.einsum("ni,ni->n", n, d)[:, None]  # as long as the cross product
    jacobian = (np.eye(3) - d[:, :, None] * d[:, None, :]) @ (
        (np.eye(3) - n[:, :, None] * n[:, None, :]) / distance[:, None, None]
    )
    squared = np.einsum("ni,ni->n", error, error) / rays.sigmas_rad**2
    weight = 1 / (1 + squared / _CAUCHY**2) / rays.sigmas_rad**2
    weighted = jacobian * weight[:, None, None]
    information = group_sums(rays.group, np.swapaxes(weighted, 1, 2) @ jacobian)
    gradient = group_sums(rays.group, np.einsum("nij,ni->nj", weighted, error))
    count = group_sums(rays.group, np.ones((len(distance), 1)))[:, 0]
    return information, gradient, group_sums(rays.group, distance) / count


def _solved(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    solution: FloatArray = np.einsum("nij,nj->ni", _inverse(matrices), vectors)
    return solution


def _inverse(matrices: FloatArray) -> FloatArray:
    """Return inverses (G, 3, 3) of symmetric matrices, NaN of singular ones."""
    scale = np.trace(matrices, axis1=1, axis2=2)
    is_good = np.isfinite(matrices).all(axis=(1, 2)) & (scale > 0)
    safe = np.where(is_good[:, None, None], matrices, np.eye(3))
    safe_scale = np.where(is_good, scale, 1.0)[:, None, None]
    is_good &= np.linalg.det(safe / safe_scale) > 1e-18
    safe = np.where(is_good[:, None, None], safe, np.eye(3))
    inverse = np.linalg.inv(safe / safe_scale) / safe_scale
    return np.where(is_good[:, None, None], (inverse + np.swapaxes(inverse, 1, 2)) / 2, np.nan)
