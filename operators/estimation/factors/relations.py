"""Virtual measurements between landmarks: a point lies on a plane, planes are parallel, square, or the same.

The variance of an angle [rad^2] is the first of the covariance, that of a distance [m^2] its last.
Source: Trevor et al., OmniMapper, ICRA 2014, section III-D.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from mapstream.operators.estimation.factors.edge_ends import edge_name, require_ends
from mapstream.operators.estimation.factors.landmarks import shape_of
from mapstream.operators.estimation.factors.own_factor import OwnFactor, Residual
from mapstream.operators.estimation.keys import key_of
from mapstream.operators.estimation.noise import Factor, NoiseModels
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import hat


class _Plane:
    """A plane's normal and d, and how both follow from its tangent (3,): two of the normal, one of d."""

    def __init__(self, plane: Any) -> None:  # noqa: ANN401
        normal = plane.normal()
        self.n: FloatArray = normal.point3()
        self.d = float(plane.planeCoefficients()[3])
        self.n_by_tangent: FloatArray = np.column_stack([normal.basis(), np.zeros(3)])  # (3, 3)
        self.d_by_tangent = np.array([0.0, 0.0, 1.0])


def _pair(
    error: Callable[[_Plane, _Plane], tuple[FloatArray, FloatArray, FloatArray]],
) -> Residual:
    """Return the residual of a relation of two planes: its error, and that by either tangent."""

    def residual(
        values: Any,  # noqa: ANN401
        keys: Sequence[int],
        jacobians: list[FloatArray] | None,
    ) -> FloatArray:
        a, b = (_Plane(values.atOrientedPlane3(key)) for key in keys)
        value, by_a, by_b = error(a, b)
        if jacobians is not None:
            jacobians[0], jacobians[1] = np.asfortranarray(by_a), np.asfortranarray(by_b)
        return value

    return residual


def _parallel(a: _Plane, b: _Plane) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The cross product of the normals: the sine of the angle, whichever way they point."""
    return np.cross(a.n, b.n), -hat(b.n) @ a.n_by_tangent, hat(a.n) @ b.n_by_tangent


def _perpendicular(a: _Plane, b: _Plane) -> tuple[FloatArray, FloatArray, FloatArray]:
    by_a, by_b = b.n @ a.n_by_tangent, a.n @ b.n_by_tangent
    return np.array([a.n @ b.n]), by_a[None], by_b[None]


def _coplanar(a: _Plane, b: _Plane) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Parallel, and equally far from the map's origin."""
    side = 1.0 if a.n @ b.n >= 0 else -1.0
    sine, by_a, by_b = _parallel(a, b)
    value = np.append(sine, a.d - side * b.d)
    return value, np.vstack([by_a, a.d_by_tangent]), np.vstack([by_b, -side * b.d_by_tangent])


def _on_plane(
    values: Any,  # noqa: ANN401
    keys: Sequence[int],
    jacobians: list[FloatArray] | None,
) -> FloatArray:
    point, plane = values.atPoint3(keys[0]), _Plane(values.atOrientedPlane3(keys[1]))
    if jacobians is not None:
        jacobians[0] = np.asfortranarray(plane.n[None])
        jacobians[1] = np.asfortranarray((point @ plane.n_by_tangent + plane.d_by_tangent)[None])
    return np.array([plane.n @ point + plane.d])


def point_on_plane(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return factors on the distance from a point, `landmark_a`, to a plane, `landmark_b`."""
    return _made(map_, rows, _on_plane, lambda cov: noise_of(cov[5:, 5:]), ("point", "plane"))


def parallel(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return factors on the angle between two planes, which is zero."""
    return _made(map_, rows, _pair(_parallel), lambda cov: noise_of(np.eye(3) * cov[0, 0]))


def perpendicular(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return factors on the angle between two planes, which is 90 degrees."""
    return _made(map_, rows, _pair(_perpendicular), lambda cov: noise_of(cov[:1, :1]))


def coplanar(map_: Map, rows: IntArray, noise_of: NoiseModels) -> dict[int, Factor]:
    """Return factors on two planes that are one."""

    def noise(cov: FloatArray) -> Any:  # noqa: ANN401
        return noise_of(np.diag([*np.repeat(cov[0, 0], 3), cov[5, 5]]))

    return _made(map_, rows, _pair(_coplanar), noise)


def _made(
    map_: Map,
    rows: IntArray,
    residual: Residual,
    noise: Callable[[FloatArray], Any],
    shapes: tuple[str, str] = ("plane", "plane"),
) -> dict[int, Factor]:
    """Return a factor per edge.

    Raises:
        EstimationError: If an end is missing or of another kind, or a variance is not one.
    """
    require_ends(map_, rows, "landmark_a", "landmark_b")
    factors = {}
    for row in rows.tolist():
        ends = [int(map_.edges.landmark_a[row]), int(map_.edges.landmark_b[row])]
        found = tuple(shape_of(kind) for kind in map_.landmarks.kind[ends])
        if found != shapes:
            name = edge_name(map_, row)
            raise EstimationError(f"{name} is between {' and '.join(shapes)}, not {found}")
        keys = [key_of("landmark", end) for end in ends]
        factors[row] = OwnFactor(noise(map_.edges.covariance[row]), keys, residual)
    return factors
