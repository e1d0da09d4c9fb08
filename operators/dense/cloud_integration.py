"""Clouds of a LiDAR, or of any sensor, into a volume: each point tells the voxels around it.

Distances are measured along the surface's normal where the points around tell it, else along the ray.
What one cloud says of a voxel is merged before it changes the voxel.
Source: Oleynikova et al., Voxblox, IROS 2017 (merged rays); Pan et al., Voxfield, IROS 2022 (along normals).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.operators.dense.volume import PLACES, SIDE, VOXELS, TsdfVolume
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray, frozen

_NUM_NEIGHBOURS = 12  # that tell a normal
_LEAST_WIDTH = 0.05  # of their spread across, to that along: or they lie on a line
_MOST_THICKNESS = 0.15  # of their spread along the normal, to that across: or they are no plane
_NO_RANGE = np.inf
_BIN_RAD = 0.01  # of the picture that says how far one sees in each direction
_FREE_WEIGHT = 0.1  # of a voxel that one sees through, to one near a surface
_CHUNK = 512  # blocks at a time


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloudView:
    """Points and where they were seen from, both in the map."""

    points: FloatArray  # (N, 3) [m]
    origin: FloatArray  # (3,) [m]
    rgb: Float32Array | None = None  # (N, 3) 0 to 255; NaN where no camera saw the point

    def __post_init__(self) -> None:
        n = frozen(self, "points", np.float64, (None, 3)).shape[0]
        frozen(self, "origin", np.float64, (3,))
        if self.rgb is not None:
            frozen(self, "rgb", np.float32, (n, 3))


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudIntegration:
    """How clouds enter a volume."""

    uses_normals: bool = True
    """Measure along normals; without, along rays, as for points that are few and far apart."""
    carves: bool = True
    """Voxels that are there already and that one sees through are free."""
    fills_free_space: bool = False
    """All that one sees through gets voxels, not only what is near surfaces."""


def integrate_cloud(
    volume: TsdfVolume, view: CloudView, how: CloudIntegration = CloudIntegration()
) -> None:
    """Let a cloud change the voxels around its points, and those in front of them.

    Raises:
        MapError: If the volume would take more memory than is allowed; it is as before then.
    """
    if not len(view.points):
        return
    rays = view.points - view.origin
    ranges_m = np.linalg.norm(rays, axis=1)
    rays /= np.maximum(ranges_m, 1e-9)[:, None]
    axes = _normals(view.points, -rays) if how.uses_normals else -rays
    blocks = [volume.blocks_at(_reached(volume, view.points, axes).reshape(-1, 3))]
    if how.fills_free_space:
        blocks += _blocks_in_front(volume, view.origin, rays, ranges_m)
    near = volume.allocate(np.unique(np.concatenate(blocks), axis=0))
    if how.carves or how.fills_free_space:
        rows = np.arange(len(volume)) if how.carves else near
        _carve(volume, rows, view.origin, _horizon(rays, ranges_m))
    _merge(volume, view, axes)


def _reached(volume: TsdfVolume, points: FloatArray, axes: FloatArray) -> FloatArray:
    """Return places (N, S, 3) from behind each point to in front of it, a voxel apart."""
    steps = int(np.ceil(volume.truncation_m / volume.voxel_size_m))
    offsets_m = np.arange(-steps, steps + 1) * volume.voxel_size_m
    return points[:, None, :] + offsets_m[:, None] * axes[:, None, :]


def _merge(volume: TsdfVolume, view: CloudView, axes: FloatArray) -> None:
    """Blend the mean of what the points say of each voxel into it."""
    size_m = volume.voxel_size_m
    reached = _reached(volume, view.points, axes)
    voxels = np.floor(reached / size_m).astype(np.int64)
    across = (voxels + 0.5) * size_m - view.points[:, None, :]
    distance_m = (across * axes[:, None, :]).sum(axis=2)
    beside_m = np.sqrt(np.maximum((across * across).sum(axis=2) - distance_m**2, 0))
    is_near = (np.abs(distance_m) <= volume.truncation_m) & (beside_m <= size_m)
    voxels, distance_m = voxels[is_near], distance_m[is_near]
    blocks, places = np.divmod(voxels, SIDE)
    keys, at = np.unique(blocks, axis=0, return_inverse=True)
    rows = volume.allocate(keys)[at.ravel()]
    flat = rows * VOXELS + (places @ (SIDE * SIDE, SIDE, 1))
    targets, which = np.unique(flat, return_inverse=True)
    weight = np.maximum(1 - beside_m[is_near] / size_m, 0.05)
    added: FloatArray = np.bincount(which, weight).astype(np.float64)
    mean = np.bincount(which, weight * distance_m) / added
    _blend(volume, targets, mean, added)
    if view.rgb is not None and volume.rgb is not None:
        point = np.nonzero(is_near)[0]
        _paint(volume, targets, which, weight, view.rgb[point])


def _blend(volume: TsdfVolume, targets: IntArray, mean: FloatArray, added: FloatArray) -> None:
    row, voxel = np.divmod(targets, VOXELS)
    weight = volume.weight[row, voxel].astype(np.float64)
    total = weight + added
    distance_m = (volume.distance_m[row, voxel] * weight + mean * added) / total
    volume.distance_m[row, voxel] = distance_m
    volume.weight[row, voxel] = total


def _paint(
    volume: TsdfVolume, targets: IntArray, which: IntArray, weight: FloatArray, rgb: Float32Array
) -> None:
    """Blend colours of points into their voxels, after distances and weights."""
    if volume.rgb is None:
        return
    known = np.isfinite(rgb).all(axis=1)
    added = np.bincount(which[known], weight[known], minlength=len(targets))
    row, voxel = np.divmod(targets, VOXELS)
    share = added / volume.weight[row, voxel]
    for axis in range(3):
        sums = np.bincount(which[known], weight[known] * rgb[known, axis], minlength=len(targets))
        mean = np.divide(sums, added, out=np.zeros_like(sums), where=added > 0)
        old = volume.rgb[row, voxel, axis].astype(np.float64)
        old = np.where(np.isnan(old) & (added > 0), mean, old)
        volume.rgb[row, voxel, axis] = old + share * (mean - old)


def _normals(points: FloatArray, towards: FloatArray) -> FloatArray:
    """Return the normals (N, 3) of the surface at points, on the side of `towards`; that itself where there is none."""
    from scipy.spatial import KDTree  # noqa: PLC0415  # scipy takes its time

    if len(points) < _NUM_NEIGHBOURS:
        return towards
    _, around = KDTree(points).query(points, k=_NUM_NEIGHBOURS)
    near = points[around] - points[around].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.swapaxes(near, 1, 2) @ near)
    spread = np.sqrt(np.maximum(values, 0))
    normals: FloatArray = vectors[:, :, 0]
    facing = (normals * towards).sum(axis=1)
    normals *= np.where(facing < 0, -1.0, 1.0)[:, None]
    is_plane = spread[:, 1] > _LEAST_WIDTH * spread[:, 2]
    is_plane &= spread[:, 0] < _MOST_THICKNESS * spread[:, 1]
    return np.where(is_plane[:, None], normals, towards)


def _blocks_in_front(
    volume: TsdfVolume, origin: FloatArray, rays: FloatArray, ranges_m: FloatArray
) -> list[IntArray]:
    """Return the blocks (B, 3) that one sees through, some of them several times."""
    steps_m = np.arange(0, ranges_m.max(initial=0), 0.5 * volume.block_size_m).tolist()
    return [volume.blocks_at(origin + s * rays[ranges_m > s]) for s in steps_m]


def _bins(directions: FloatArray) -> IntArray:
    """Return the bin (N,) of the picture around the sensor that unit directions (N, 3) fall into."""
    columns = int(2 * np.pi / _BIN_RAD)
    azimuth = np.arctan2(directions[:, 1], directions[:, 0]) + np.pi
    elevation = np.arcsin(np.clip(directions[:, 2], -1, 1)) + np.pi / 2
    column = np.minimum((azimuth / _BIN_RAD).astype(np.int64), columns - 1)
    bins: IntArray = (elevation / _BIN_RAD).astype(np.int64) * columns + column
    return bins


def _horizon(rays: FloatArray, ranges_m: FloatArray) -> FloatArray:
    """Return how far one surely sees in each bin [m]: to the nearest point; 0 where there is none."""
    num_bins = (int(np.pi / _BIN_RAD) + 1) * int(2 * np.pi / _BIN_RAD)
    nearest_m = np.full(num_bins, _NO_RANGE)
    np.minimum.at(nearest_m, _bins(rays), ranges_m)
    nearest_m[np.isinf(nearest_m)] = 0
    return nearest_m


def _carve(volume: TsdfVolume, rows: IntArray, origin: FloatArray, horizon_m: FloatArray) -> None:
    """Say of voxels that lie well in front of all that is seen in their direction that they are free."""
    reach_m = float(horizon_m.max(initial=0)) + volume.block_size_m
    away_m = np.linalg.norm(volume.middles_m(rows) - origin, axis=1)
    rows = rows[away_m < reach_m]
    for start in range(0, len(rows), _CHUNK):
        _carve_blocks(volume, rows[start : start + _CHUNK], origin, horizon_m)


def _carve_blocks(
    volume: TsdfVolume, rows: IntArray, origin: FloatArray, horizon_m: FloatArray
) -> None:
    voxels = (volume.blocks[rows] * SIDE)[:, None, :] + PLACES + 0.5
    rays = (voxels * volume.voxel_size_m - origin).reshape(-1, 3)
    ranges_m = np.maximum(np.linalg.norm(rays, axis=1), 1e-9)
    free: BoolArray = (
        ranges_m < horizon_m[_bins(rays / ranges_m[:, None])] - 2 * volume.truncation_m
    )
    block, voxel = np.divmod(np.flatnonzero(free), VOXELS)
    targets = rows[block] * VOXELS + voxel
    full = np.full(len(targets), volume.truncation_m)
    _blend(volume, targets, full, np.full(len(targets), _FREE_WEIGHT))
