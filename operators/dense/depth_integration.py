"""Depth images into a volume: each voxel looks up the pixel that it projects to.

Source: Curless and Levoy, A volumetric method for building complex models from range images, SIGGRAPH 1996;
Newcombe et al., KinectFusion, ISMAR 2011; weights as in Oleynikova et al., Voxblox, IROS 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mapstream.operators.dense.depth_views import ColorView, DepthView, Pinhole
from mapstream.operators.dense.silhouettes import least_distances_m
from mapstream.operators.dense.volume import PLACES, SIDE, VOXELS, TsdfVolume
from mapstream.streams.arrays import BoolArray, Float32Array, IntArray

_CHUNK = 192  # blocks at a time: their arrays stay in a core's cache
_TILE_PX = 16  # of the coarse image that says how far one sees


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthIntegration:
    """How depth images enter a volume."""

    carves: bool = True
    """Voxels that are there already and that one sees through are free."""
    fills_free_space: bool = False
    """All that one sees through gets voxels, not only what is near surfaces."""


def integrate_depth(
    volume: TsdfVolume, view: DepthView, how: DepthIntegration = DepthIntegration()
) -> None:
    """Let a view change the voxels that it sees, those near its surfaces and those in front of them.

    Distances are measured along the view. A measurement counts by the inverse square of its depth, as the
    noise of stereo and structured light grows; behind the surface it fades out.

    Raises:
        MapError: If the volume would take more memory than is allowed; it is as before then.
    """
    blocks = _blocks_near_surface(volume, view)
    if how.fills_free_space:
        blocks = np.concatenate([blocks, _blocks_in_front(volume, view)])
    rows = volume.allocate(blocks)
    is_wanted = np.zeros(len(volume), np.bool_)
    is_wanted[rows] = True
    if how.carves:
        others = np.flatnonzero(~is_wanted)
        is_wanted[others[_is_in_view(volume, others, view)]] = True
    chosen = np.flatnonzero(is_wanted)
    lookup = _Lookup(volume, view)
    for start in range(0, len(chosen), _CHUNK):
        _update(volume, chosen[start : start + _CHUNK], lookup)


class _Lookup:
    """What is the same for all blocks of a view."""

    def __init__(self, volume: TsdfVolume, view: DepthView) -> None:
        self.height, self.width = view.depth_m.shape
        nothing = np.full(1, np.nan, np.float32)  # the pixel of what is not in the image
        self.depth_m = np.concatenate([view.depth_m.ravel(), nothing])
        least_m = least_distances_m(view, volume.voxel_size_m, volume.truncation_m)
        self.least_m = np.concatenate([least_m.ravel(), nothing])
        self.pinhole, self.color = view.pinhole, view.color


def _update(volume: TsdfVolume, rows: IntArray, lookup: _Lookup) -> None:
    """Change the voxels of some blocks."""
    truncation_m = np.float32(volume.truncation_m)
    x, y, z = _projected(volume, rows, lookup.pinhole)
    pixel = _pixels(x, y, z, lookup.width, lookup.height)
    distance_m = lookup.depth_m.take(pixel) - z
    is_seen = distance_m > lookup.least_m.take(pixel)  # false where there is no depth
    if not is_seen.any():
        return
    fading = np.float32(1 / max(volume.truncation_m - volume.voxel_size_m, 1e-9))
    added = np.clip((distance_m + truncation_m) * fading, 0, 1)
    added /= z * z
    added[~is_seen] = 0
    np.minimum(distance_m, truncation_m, out=distance_m)
    distance_m[~is_seen] = 0
    if lookup.color is not None and volume.rgb is not None:
        _paint(volume, rows, lookup.color, np.where(distance_m < truncation_m, added, 0))
    weight = volume.weight[rows]
    total = weight + added
    mean = volume.distance_m[rows] * weight
    mean += distance_m * added
    mean /= np.where(total > 0, total, 1)
    volume.distance_m[rows] = mean
    volume.weight[rows] = total


def _paint(volume: TsdfVolume, rows: IntArray, color: ColorView, added: Float32Array) -> None:
    """Blend the colours of voxels near the surface; the weights of before are those of the distances."""
    if volume.rgb is None:
        return
    at = np.flatnonzero(added)
    block, voxel = np.divmod(at, VOXELS)
    points = (volume.blocks[rows[block]] * SIDE + PLACES[voxel] + 0.5) * np.float64(
        volume.voxel_size_m
    )
    pixels, is_in = color.pinhole.pixels(points, color.rgb.shape)
    seen = color.rgb[pixels[is_in, 1], pixels[is_in, 0]].astype(np.float32)
    block, voxel, new = rows[block[is_in]], voxel[is_in], added.ravel()[at[is_in]]
    share = (new / (volume.weight[block, voxel] + new))[:, None]
    old = volume.rgb[block, voxel].astype(np.float32)
    old = np.where(np.isnan(old), seen, old)
    volume.rgb[block, voxel] = (old + share * (seen - old)).astype(np.float16)


def _projected(
    volume: TsdfVolume, rows: IntArray, pinhole: Pinhole
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Return `depth * x`, `depth * y` [m px] and depth [m] of the voxels (B, VOXELS) of blocks."""
    projection = pinhole.projection()
    projection[:2] += 0.5 * projection[2]  # so that cutting off rounds
    corner = (volume.blocks[rows] * SIDE + 0.5) * volume.voxel_size_m
    of_block = (corner @ projection[:, :3].T + projection[:, 3]).astype(np.float32)
    of_voxel = (volume.voxel_size_m * PLACES @ projection[:, :3].T).astype(np.float32)
    x, y, z = (of_block[:, None, axis] + of_voxel[None, :, axis] for axis in range(3))
    return x, y, z


def _pixels(
    x: Float32Array, y: Float32Array, z: Float32Array, width: int, height: int
) -> npt.NDArray[np.int32]:
    """Return the number of each voxel's pixel; the one after the last for those out of the image."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = 1 / z
        x *= inverse
        y *= inverse
        is_in = (z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        pixel = y.astype(np.int32) * np.int32(width) + x.astype(np.int32)
    pixel[~is_in] = width * height
    return pixel


def _step_px(volume: TsdfVolume, view: DepthView) -> int:
    """Return how many pixels apart rays may be so that no block of a surface lies between them."""
    farthest_m = float(np.nanmax(view.depth_m, initial=0.0))
    focal_px = float(view.pinhole.camera_matrix[0, 0])
    if farthest_m <= 0:
        return 1
    return max(1, int(0.25 * volume.block_size_m * focal_px / farthest_m))


def _blocks_near_surface(volume: TsdfVolume, view: DepthView) -> IntArray:
    """Return the blocks (B, 3) that are less than the truncation from a measured point."""
    depth_m, rays = view.rays(_step_px(volume, view))
    origin = view.pinhole.T_map_camera[:3, 3]
    steps = int(np.ceil(2 * volume.truncation_m / (0.5 * volume.block_size_m)))
    offsets = np.linspace(-volume.truncation_m, volume.truncation_m, steps + 1)
    reach = (depth_m[:, None] + offsets)[:, :, None] * rays[:, None, :]
    return volume.blocks_at(origin + reach.reshape(-1, 3))


def _blocks_in_front(volume: TsdfVolume, view: DepthView) -> IntArray:
    """Return the blocks (B, 3) that one sees through."""
    depth_m, rays = view.rays(_step_px(volume, view))
    origin = view.pinhole.T_map_camera[:3, 3]
    steps_m = np.arange(0, depth_m.max(initial=0), 0.5 * volume.block_size_m).tolist()
    found = [volume.blocks_at(origin + step * rays[depth_m > step]) for step in steps_m]
    return np.unique(np.concatenate([np.empty((0, 3), np.int64), *found]), axis=0)


def _is_in_view(volume: TsdfVolume, rows: IntArray, view: DepthView) -> BoolArray:
    """Return which blocks (B,) may be in the image, and not behind all that is seen around them."""
    projection = view.pinhole.projection()
    x, y, z = projection[:, :3] @ volume.middles_m(rows).T + projection[:, 3:]
    radius_m = np.sqrt(3) / 2 * volume.block_size_m
    height, width = view.depth_m.shape
    is_in: BoolArray = z > -radius_m
    near_m = np.maximum(z, 0.25 * radius_m)
    radius_px = radius_m * view.pinhole.camera_matrix[0, 0] / near_m
    x, y = x / near_m, y / near_m
    is_in &= (x > -radius_px) & (x < width + radius_px)
    is_in &= (y > -radius_px) & (y < height + radius_px)
    reach_m = _coarse_reach(view.depth_m)
    at = tuple(
        np.clip(p / _TILE_PX, 0, n - 1).astype(np.int64)
        for p, n in zip((y, x), reach_m.shape, strict=True)
    )
    is_behind = (z - radius_m > reach_m[at] + volume.truncation_m) & (radius_px < _TILE_PX)
    found: BoolArray = is_in & ~is_behind
    return found


def _coarse_reach(depth_m: Float32Array) -> Float32Array:
    """Return the farthest depth in each tile and those around it [m]; 0 where nothing is seen."""
    rows, columns = (-(-n // _TILE_PX) for n in depth_m.shape)
    padded = np.zeros((rows * _TILE_PX, columns * _TILE_PX), np.float32)
    padded[: depth_m.shape[0], : depth_m.shape[1]] = np.nan_to_num(depth_m)
    reach_m = padded.reshape(rows, _TILE_PX, columns, _TILE_PX).max(axis=(1, 3))
    around = np.pad(reach_m, 1)
    shifted = [around[i : i + rows, j : j + columns] for i in range(3) for j in range(3)]
    farthest: Float32Array = np.max(shifted, axis=0)
    return farthest
