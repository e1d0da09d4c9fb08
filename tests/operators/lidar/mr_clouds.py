"""Clouds of a small LiDAR in the buildings of W-MR, and poses along its ways."""

from __future__ import annotations

from functools import cache

import numpy as np

from mapstream.recordings.worlds.building import Building, building
from mapstream.recordings.worlds.building_tour import tour
from mapstream.recordings.worlds.mesh import Mesh
from mapstream.recordings.worlds.ray_caster import RayCaster
from mapstream.recordings.worlds.surface_mesh import mesh_of
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.geometry import SE3

_HEIGHT_M = 0.9
_BEAMS, _COLUMNS = 24, 300
_NOISE_M = 0.01
_SPEED_MPS = 0.8


@cache
def _building(seed: int) -> Building:
    return building(seed, texel_m=0.2)


@cache
def _mesh(seed: int) -> Mesh:
    return mesh_of(_building(seed).surfaces)


@cache
def _rays() -> FloatArray:
    azimuth = 2 * np.pi * np.arange(_COLUMNS) / _COLUMNS
    elevation = np.radians(np.linspace(-22.5, 22.5, _BEAMS))
    flat, up = np.cos(elevation)[:, None], np.sin(elevation)[:, None]
    rays = [flat * np.cos(azimuth), flat * np.sin(azimuth), up + 0 * azimuth]
    return np.stack(rays, axis=-1).reshape(-1, 3)


class Sights:
    """What a LiDAR sees in a building."""

    def __init__(self, building_seed: int = 0) -> None:
        self._caster = RayCaster(_mesh(building_seed))

    def __call__(self, T_world_base: SE3, seed: int) -> Float32Array:
        """Return the points (N, 3) seen from a pose of the base, in its frame."""
        directions = _rays() @ T_world_base.R.T
        origin = T_world_base @ np.array([0, 0, _HEIGHT_M])
        origins = np.broadcast_to(origin, directions.shape)
        ranges_m = self._caster.cast(np.ascontiguousarray(origins), directions).ranges_m
        ranges_m += np.random.default_rng(seed).normal(0, _NOISE_M, len(ranges_m))
        points: FloatArray = ranges_m[:, None] * _rays() + [0, 0, _HEIGHT_M]
        return points.astype(np.float32)


def way(number: int, spacing_m: float, length_m: float, building_seed: int = 0) -> list[SE3]:
    """Return poses T_world_base, so far apart, along one of the ways through a building."""
    duration_s = length_m / _SPEED_MPS + 4.0
    motion = tour(
        _building(building_seed).rooms, number, duration_s, _SPEED_MPS, 0, is_carried=False
    )
    steps_ns = np.arange(4.0, duration_s, spacing_m / _SPEED_MPS) * 1e9  # from full speed on
    return [SE3(T) for T in motion.poses(steps_ns.astype(np.int64))]
