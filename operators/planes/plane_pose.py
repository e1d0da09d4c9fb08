"""A pose from planes that are seen and planes that are known: least squares of normals and distances.

Three planes in general position give all of it; fewer leave directions open, whose information is zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3, hat

_STEPS = 5
_OPEN = 1e-6  # eigenvalue, over the largest one, of a direction that nothing measures


@dataclass(frozen=True, slots=True, eq=False)
class PlaneSet:
    """Planes in one frame."""

    normals: FloatArray  # (N, 3)
    points: FloatArray  # (N, 3) one on each

    @property
    def offsets(self) -> FloatArray:
        """Return d (N,) of n.p + d = 0."""
        offsets: FloatArray = -np.einsum("ni,ni->n", self.normals, self.points)
        return offsets

    def chosen(self, rows: IntArray) -> PlaneSet:
        """Return some of them."""
        return PlaneSet(self.normals[rows], self.points[rows])


@dataclass(frozen=True, slots=True, kw_only=True)
class PlaneNoise:
    """How far a plane that is seen may be from the one that is known."""

    sigma_rad: float
    sigma_m: float


def pose_from_planes(
    known: PlaneSet, seen: PlaneSet, T_known_seen: SE3, noise: PlaneNoise
) -> tuple[SE3, FloatArray]:
    """Return the pose that lays planes on planes, row by row, and the information (6, 6) on it.

    Args:
        known: N planes.
        seen: The same N, in another frame.
        T_known_seen: A pose that is near.
        noise: Of each pair.
    """
    T, information = T_known_seen, np.zeros((6, 6))
    for _ in range(_STEPS):
        errors, jacobian = _linearised(known, seen, T, noise)
        information = jacobian.T @ jacobian
        values, vectors = np.linalg.eigh(information)
        is_measured = values > _OPEN * max(values[-1], 1e-12)
        inverse = np.where(is_measured, 1 / np.where(is_measured, values, 1.0), 0.0)
        T = T @ SE3.exp(-vectors @ (inverse * (vectors.T @ (jacobian.T @ errors))))
    return T, information


def pose_covariance(information: FloatArray, open_sigma: float) -> FloatArray:
    """Return the covariance (6, 6) of a pose, wide where nothing was measured."""
    return np.linalg.inv(information + np.eye(6) / open_sigma**2).astype(np.float64)


def _linearised(
    known: PlaneSet, seen: PlaneSet, T: SE3, noise: PlaneNoise
) -> tuple[FloatArray, FloatArray]:
    """Return errors (4N,) in units of sigma and their Jacobian (4N, 6) by a small motion on the right."""
    n = known.normals
    across = (
        np.eye(3) - n[:, :, None] * n[:, None, :]
    )  # what of a direction is not along the normal
    turned = seen.normals @ T.R.T
    of_normals = np.einsum("nij,nj->ni", across, turned) / noise.sigma_rad
    of_points = np.einsum("ni,ni->n", n, seen.points @ T.R.T + T.t) + known.offsets
    normals_by_motion = np.zeros((len(n), 3, 6))
    normals_by_motion[:, :, :3] = -across @ (T.R @ hat(seen.normals)) / noise.sigma_rad
    points_by_motion = np.concatenate(
        [-np.einsum("ni,nij->nj", n, T.R @ hat(seen.points)), n @ T.R], axis=1
    )
    errors = np.concatenate([of_normals.ravel(), of_points / noise.sigma_m])
    jacobian = np.concatenate([normals_by_motion.reshape(-1, 6), points_by_motion / noise.sigma_m])
    return errors, jacobian
