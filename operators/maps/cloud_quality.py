"""How sharp a cloud is: a quality of maps that needs no truth.

Poses that are wrong draw a wall twice, or thick. Around each point the neighbours within a radius have a
covariance S (3, 3). The mean map entropy is the mean of ln |2 pi e S| / 2 (Droeschel, Stueckler, Behnke: Local
multi-resolution representation for 6D motion estimation and mapping with a continuously rotating 3D laser
scanner, ICRA 2014); the mean plane variance is the mean of S's smallest eigenvalue (Razlaw et al., Evaluation of
registration methods for sparse 3D laser scans, ECMR 2015). Smaller is sharper. Both compare maps of one place.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from pydantic import PositiveFloat, PositiveInt

from mapstream.operators.maps.aggregate import AggregateConfig, aggregate_cloud
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import MapError

_MIN_NEIGHBOURS = 8  # fewer have no shape
_LEAST_VARIANCE_M2 = 1e-8  # of a cloud without noise: 0.1 mm
_AT_ONCE = 20_000  # points whose neighbours are looked at together


class CloudQualityConfig(AggregateConfig):
    """Options of `cloud_quality`."""

    voxel_size_m: PositiveFloat = 0.03
    """One point is left per voxel: much below the thickness that is to be seen."""
    radius_m: PositiveFloat = 0.3
    """Of the neighbourhood of a point."""
    max_points: PositiveInt = 50_000
    """So many points, spread evenly, are asked for their neighbours."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudQuality:
    """Figures that are smaller for a sharper cloud."""

    entropy: float  # mean map entropy [nats]
    plane_sigma_m: float  # root of the mean plane variance: how thick surfaces are
    num_points: int  # whose neighbourhoods count
    num_lonely: int  # with too few neighbours to have one


def map_cloud_quality(map_: Map, folder: Path, config: CloudQualityConfig) -> CloudQuality:
    """Return how sharp the cloud of all keyframes is, where the poses put it.

    Raises:
        MapError: If the map has no clouds, or its points have no neighbours.
    """
    return cloud_quality(aggregate_cloud(map_, folder, config).points, config)


def cloud_quality(points: npt.NDArray[np.floating], config: CloudQualityConfig) -> CloudQuality:
    """Return how sharp a cloud (N, 3) [m] is.

    Raises:
        MapError: If none of its points has neighbours.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  # scipy takes its time

    cloud = np.asarray(points, dtype=np.float64)
    tree = cKDTree(cloud)
    step = max(1, -(-len(cloud) // config.max_points))
    asked = cloud[::step]
    shapes = [
        _covariances(cloud, tree.query_ball_point(asked[at : at + _AT_ONCE], config.radius_m))
        for at in range(0, len(asked), _AT_ONCE)
    ]
    found = np.concatenate([np.empty((0, 3, 3)), *shapes])
    if not len(found):
        raise MapError(
            f"no point of the cloud has {_MIN_NEIGHBOURS} neighbours within {config.radius_m} m;"
            " use a larger radius_m or a smaller voxel_size_m"
        )
    variances = np.maximum(np.linalg.eigvalsh(found), _LEAST_VARIANCE_M2)
    entropies = (3 * np.log(2 * np.pi * np.e) + np.log(variances).sum(axis=1)) / 2
    return CloudQuality(
        entropy=float(entropies.mean()),
        plane_sigma_m=float(np.sqrt(variances[:, 0].mean())),
        num_points=len(found),
        num_lonely=len(asked) - len(found),
    )


def _covariances(cloud: FloatArray, neighbours: npt.NDArray[np.object_]) -> FloatArray:
    """Return the covariances (M, 3, 3) of those neighbourhoods that have enough points."""
    sizes = np.array([len(rows) for rows in neighbours])
    kept = np.flatnonzero(sizes >= _MIN_NEIGHBOURS)
    if not len(kept):
        return np.empty((0, 3, 3))
    rows = np.concatenate([neighbours[at] for at in kept.tolist()]).astype(np.int64)
    counts = sizes[kept]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    points = cloud[rows] - np.repeat(cloud[rows[starts]], counts, axis=0)  # small numbers
    means = np.add.reduceat(points, starts) / counts[:, None]
    squares = np.add.reduceat(points[:, :, None] * points[:, None, :], starts)
    covariances: FloatArray = (
        squares / counts[:, None, None] - means[:, :, None] * means[:, None, :]
    )
    return covariances
