"""Registration of two point sets, behind one interface.

Built in by one word: `icp` (Besl and McKay, PAMI 1992), `plane` (Chen and Medioni, 1992), `gicp` (Segal et
al., Generalized-ICP, RSS 2009), `vgicp` (Koide et al., Voxelized GICP, ICRA 2021), all through small_gicp.
Any other word is looked up among the installed entry points of the group `mapstream.registrations`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from typing import Any, Literal, Protocol, get_args

import numpy as np
import numpy.typing as npt
import small_gicp

from mapstream.operators.lidar.observability import covariance_of_planes
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import ConfigError, EstimationError
from mapstream.streams.geometry import SE3

Points = npt.NDArray[np.floating]  # (N, 3) [m]
Method = Literal["icp", "plane", "gicp", "vgicp"]
GROUP = "mapstream.registrations"

_TYPES: dict[str, str] = {"icp": "ICP", "plane": "PLANE_ICP", "gicp": "GICP", "vgicp": "GICP"}
_VOXEL_PER_DISTANCE = (
    0.7  # vgicp: voxels find only what lies in them, so they come last, after gicp
)
_NUM_NEIGHBORS = 15  # for a point's normal and covariance
_MIN_POINTS = _NUM_NEIGHBORS + 5  # fewer say nothing; an empty tree crashes small_gicp


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RegistrationResult:
    """How well two point sets fit, and where. Whether to believe it is the caller's decision."""

    T_target_source: SE3
    covariance: FloatArray  # (6, 6) of the tangent vector at the source, rotation first [rad, m]
    inlier_fraction: float  # of the source points, those that lie on the target's surface
    rmse_m: float  # of the inliers, across the surface
    converged: bool


class Registration(Protocol):
    """Anything that aligns two point sets."""

    def align(self, source: Points, target: Points, T_guess: SE3) -> RegistrationResult:
        """Find where the source lies in the target's frame, starting from T_guess.

        Raises:
            EstimationError: If one of the sets is too small to say anything.
        """
        ...


def make_registration(
    name: str,
    options: Mapping[str, Any] | None = None,
    **built_in: Any,  # noqa: ANN401  # fields of SmallGicp
) -> Registration:
    """Return the registration that a config names.

    Args:
        name: One of the words above, or the name of an installed entry point.
        options: Of the config's user: for an installed one all that it gets.
        built_in: Options of `SmallGicp`, for the built-in ones, where the user gave no other.

    Raises:
        ConfigError: If the name is neither built in nor installed.
    """
    if name in get_args(Method):
        return SmallGicp(method=name, **{**built_in, **(options or {})})
    installed = {entry.name: entry for entry in entry_points(group=GROUP)}
    if name not in installed:
        known = sorted([*get_args(Method), *installed])
        raise ConfigError(f"unknown registration {name!r}; known: {', '.join(known)}")
    made: Registration = installed[name].load()(**(options or {}))
    return made


@dataclass(frozen=True, slots=True)
class _Prepared:
    """One point set with what small_gicp needs of it."""

    cloud: Any  # small_gicp.PointCloud with normals and covariances
    tree: Any  # small_gicp.KdTree
    points: FloatArray  # (M, 3) as sampled
    normals: FloatArray  # (M, 3)


@dataclass(slots=True)
class SmallGicp:
    """ICP and its kin, from coarse to fine: the result at one search distance starts the next.

    One thread always: two give other results each time, and OpenMP's spinning makes them slower here.
    """

    method: str = "gicp"
    leaf_size_m: float | None = 0.25  # one averaged point per voxel; None takes every point
    search_distances_m: tuple[float, ...] = (2.0, 0.5)  # of corresponding points, coarse to fine
    inlier_distance_m: float = 0.1  # across the surface
    max_iterations: int = 30
    _ready: dict[str, tuple[Points, _Prepared]] = field(
        default_factory=dict, init=False, repr=False
    )

    def align(self, source: Points, target: Points, T_guess: SE3) -> RegistrationResult:
        """Align as `Registration.align` says; an array that comes again is not prepared again."""
        ready_target = self._prepared("target", target)
        ready_source = self._prepared("source", source)
        T, converged = T_guess.matrix, False
        for distance_m in self.search_distances_m:
            result = self._align_once(ready_source, ready_target, T, distance_m)
            T, converged = result.T_target_source, bool(result.converged)
        raw = SE3(T)  # products of many rotations are no longer quite one
        T_target_source = SE3.from_quat_xyzw(raw.quat_xyzw, raw.t)
        return self._judge(ready_source, ready_target, T_target_source, converged=converged)

    def _prepared(self, role: str, points: Points) -> _Prepared:
        known = self._ready.get(role)
        if known is None or known[0] is not points:
            known = (points, _prepare(points, self.leaf_size_m, role))
            self._ready[role] = known
        return known[1]

    def _align_once(
        self,
        source: _Prepared,
        target: _Prepared,
        T: npt.NDArray[np.float64],
        distance_m: float,
    ) -> Any:  # noqa: ANN401  # small_gicp has no types
        options = {
            "init_T_target_source": T,
            "max_correspondence_distance": distance_m,
            "max_iterations": self.max_iterations,
            "num_threads": 1,
        }
        if self.method == "vgicp" and distance_m == self.search_distances_m[-1]:
            voxels = small_gicp.GaussianVoxelMap(_VOXEL_PER_DISTANCE * distance_m)
            voxels.insert(target.cloud)
            return small_gicp.align(voxels, source.cloud, **options)
        kind = _TYPES[self.method]
        return small_gicp.align(
            target.cloud, source.cloud, target.tree, registration_type=kind, **options
        )

    def _judge(
        self, source: _Prepared, target: _Prepared, T: SE3, *, converged: bool
    ) -> RegistrationResult:
        """Measure the fit by the source's distances from the target's tangent planes.

        It is the same for every method, so that thresholds and covariances can be compared.
        """
        moved = T @ source.points
        nearest, squared = target.tree.batch_nearest_neighbor_search(moved)
        nearest = np.asarray(nearest, dtype=np.int64)
        normals = target.normals[nearest]
        across = np.einsum("ij,ij->i", normals, moved - target.points[nearest])
        near = np.asarray(squared) < self.search_distances_m[-1] ** 2
        inlier = near & (np.abs(across) < self.inlier_distance_m)
        rmse_m = float(np.sqrt(np.mean(across[inlier] ** 2))) if inlier.any() else float("inf")
        covariance = covariance_of_planes(source.points[inlier], normals[inlier] @ T.R, rmse_m)
        return RegistrationResult(
            T_target_source=T,
            covariance=covariance,
            inlier_fraction=float(inlier.mean()),
            rmse_m=rmse_m,
            converged=converged and bool(inlier.any()),
        )


def _prepare(points: Points, leaf_size_m: float | None, role: str) -> _Prepared:
    finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    if len(finite) >= _MIN_POINTS:
        cloud = small_gicp.PointCloud(finite)
        if leaf_size_m is not None:
            cloud = small_gicp.voxelgrid_sampling(cloud, leaf_size_m, 1)
        if cloud.size() >= _MIN_POINTS:
            tree = small_gicp.KdTree(cloud, 1)
            small_gicp.estimate_normals_covariances(cloud, tree, _NUM_NEIGHBORS, 1)
            sampled = cloud.points()[:, :3].copy()
            return _Prepared(cloud, tree, sampled, cloud.normals()[:, :3].copy())
    raise EstimationError(
        f"registration: the {role} has {len(finite)} finite points of {len(points)}; "
        f"at least {_MIN_POINTS} after sampling are needed"
    )
