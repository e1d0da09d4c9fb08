"""How far it is to the nearest surface from anywhere, and what is free, occupied or unknown.

Source: Oleynikova et al., Voxblox, IROS 2017 (distances from a TSDF); Felzenszwalb and Huttenlocher, Distance
transforms of sampled functions, Theory of Computing 8, 2012, by way of scipy.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import NonNegativeFloat, PositiveFloat

from mapstream.operators.dense.fusion import FusionConfig, FusionReport, Progress, fuse
from mapstream.operators.dense.volume import SIDE, TsdfVolume
from mapstream.operators.dense.volume_files import read_arrays, write_arrays
from mapstream.recordings.maps.folder import write_whole
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, frozen
from mapstream.streams.errors import MapError, MapFormatError

_BYTES_PER_VOXEL = 60  # while the field is made


class FieldConfig(FusionConfig):
    """What is fused, and how far distances reach."""

    max_distance_m: PositiveFloat = 5.0
    """Longer distances are not told apart."""
    min_weight: NonNegativeFloat = 0.0
    """Voxels of no more weight count as not seen."""


class State(IntEnum):
    """What is known of a voxel."""

    UNKNOWN = 0
    FREE = 1
    OCCUPIED = 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DistanceField:
    """Distances on a regular grid; the middle of voxel (0, 0, 0) is `origin_m`."""

    origin_m: FloatArray  # (3,) in the map
    voxel_size_m: float
    distance_m: Float32Array  # (X, Y, Z) to the nearest surface; negative behind it
    state: npt.NDArray[np.uint8]  # (X, Y, Z) of `State`

    def __post_init__(self) -> None:
        frozen(self, "origin_m", np.float64, (3,))
        shape = frozen(self, "distance_m", np.float32, (None, None, None)).shape
        frozen(self, "state", np.uint8, shape)

    def distances(self, points: npt.ArrayLike) -> FloatArray:
        """Return the distances (N,) [m] at points (N, 3) of the map, between voxels linearly; NaN outside."""
        from scipy.ndimage import map_coordinates  # noqa: PLC0415  # scipy takes its time

        at = self._voxels(points)
        found = map_coordinates(self.distance_m, at.T, np.float64, order=1, mode="nearest")
        return np.where(self._is_inside(at), found, np.nan)

    def states(self, points: npt.ArrayLike) -> npt.NDArray[np.uint8]:
        """Return the `State` (N,) at points (N, 3) of the map; outside it is unknown."""
        at = self._voxels(points)
        is_inside = self._is_inside(at)
        nearest = np.rint(np.where(is_inside[:, None], at, 0)).astype(np.int64)
        return np.where(is_inside, self.state[tuple(nearest.T)], np.uint8(State.UNKNOWN))

    def picture(self, z_m: float) -> npt.NDArray[np.uint8]:
        """Return the slice (Y, X, 3), bgr, at a height of the map: red near surfaces, blue far, grey unknown.

        Raises:
            MapError: If the slice does not cross the field.
        """
        layer = int(np.rint((z_m - self.origin_m[2]) / self.voxel_size_m))
        if not 0 <= layer < self.distance_m.shape[2]:
            top_m = self.origin_m[2] + self.voxel_size_m * (self.distance_m.shape[2] - 1)
            raise MapError(
                f"no slice at {z_m} m: the field is {self.origin_m[2]:.2f} to {top_m:.2f} m"
            )
        distance_m, state = self.distance_m[:, :, layer].T, self.state[:, :, layer].T
        scale = max(float(np.abs(distance_m).max(initial=0)), 1e-9)
        near = np.asarray(255 * (1 - np.abs(distance_m) / scale), np.uint8)
        image = np.asarray(cv2.applyColorMap(near, cv2.COLORMAP_TURBO), np.uint8)
        image[state == State.UNKNOWN] = 128
        image[state == State.OCCUPIED] = 0
        return np.ascontiguousarray(image[::-1])

    def _voxels(self, points: npt.ArrayLike) -> FloatArray:
        at: FloatArray = (np.asarray(points, np.float64) - self.origin_m) / self.voxel_size_m
        return at

    def _is_inside(self, at: FloatArray) -> BoolArray:
        is_inside = (at >= 0) & (at <= np.array(self.distance_m.shape) - 1)
        return np.asarray(is_inside.all(axis=1), np.bool_)


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldReport:
    """What was fused, and what is known of the voxels."""

    fused: FusionReport
    num_voxels: dict[str, int]  # by state


def field_of_map(
    map_: Map, folder: Path, config: FieldConfig, on_progress: Progress = lambda _: None
) -> tuple[DistanceField, FieldReport]:
    """Fuse what a map saw, free space as well, and return the distances in it.

    Raises:
        MapError: If there is nothing to fuse or no surface, or it needs more memory than is allowed.
        RecordingError: If a recording is not there.
    """
    volume, fused = fuse(map_, folder, config, fills_free_space=True, on_progress=on_progress)
    field = distance_field(
        volume, max_distance_m=config.max_distance_m, min_weight=config.min_weight
    )
    counts = np.bincount(field.state.ravel(), minlength=len(State)).tolist()
    num_voxels = {state.name.lower(): counts[state] for state in State}
    return field, FieldReport(fused=fused, num_voxels=num_voxels)


def distance_field(
    volume: TsdfVolume, *, max_distance_m: float, min_weight: float = 0.0
) -> DistanceField:
    """Return the distances around all that a volume holds.

    The nearest voxel at a surface is found exactly; from it the distance goes on to the surface itself, so
    that errors stay well below a voxel.

    Raises:
        MapError: If there is no surface, or the field needs more memory than the volume may have.
    """
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415  # scipy takes its time

    low = volume.blocks.min(axis=0, initial=0) if not len(volume) else volume.blocks.min(axis=0)
    high = low + 1 if not len(volume) else volume.blocks.max(axis=0) + 1
    shape = (high - low) * SIDE
    needed = int(np.prod(shape)) * _BYTES_PER_VOXEL
    if needed > volume.max_bytes:
        raise MapError(
            f"a field of {' x '.join(map(str, shape))} voxels needs {needed / 1e6:.0f} MB of the "
            f"{volume.max_bytes / 1e6:.0f} MB that it may have; use larger voxels (voxel_size_m), a shorter reach "
            "(max_range_m), or more memory (max_bytes)"
        )
    tsdf_m, is_seen = _dense(volume, low, shape, min_weight)
    is_site = _crossings(tsdf_m, is_seen)
    if not is_site.any():
        raise MapError("the volume holds no surface to measure distances from")
    nearest = distance_transform_edt(~is_site, return_distances=False, return_indices=True)
    surface = _surface_points(tsdf_m, is_seen, is_site, volume.voxel_size_m)
    squares = np.zeros(tuple(shape), np.float32)
    for axis in range(3):
        grid = np.arange(shape[axis], dtype=np.float32).reshape(
            [-1 if a == axis else 1 for a in range(3)]
        )
        squares += (grid - surface[axis][tuple(nearest)]) ** 2
    distance_m = np.minimum(np.sqrt(squares) * np.float32(volume.voxel_size_m), max_distance_m)
    is_behind = is_seen & (tsdf_m < 0)
    state = np.where(is_seen, State.FREE, State.UNKNOWN).astype(np.uint8)
    state[is_seen & (tsdf_m < 0.5 * volume.voxel_size_m)] = State.OCCUPIED
    return DistanceField(
        origin_m=(low * SIDE + 0.5) * volume.voxel_size_m,
        voxel_size_m=volume.voxel_size_m,
        distance_m=np.where(is_behind, -distance_m, distance_m).astype(np.float32),
        state=state,
    )


def _dense(
    volume: TsdfVolume, low: npt.NDArray[np.int64], shape: npt.NDArray[np.int64], min_weight: float
) -> tuple[Float32Array, BoolArray]:
    """Return the distances and what was seen, on a grid (X, Y, Z)."""
    tsdf_m = np.full(tuple(shape), volume.truncation_m, np.float32)
    is_seen = np.zeros(tuple(shape), np.bool_)
    cube = (SIDE, SIDE, SIDE)
    for row, block in enumerate((volume.blocks - low) * SIDE):
        at = tuple(slice(start, start + SIDE) for start in block.tolist())
        is_seen[at] = (volume.weight[row] > min_weight).reshape(cube)
        tsdf_m[at] = np.where(is_seen[at], volume.distance_m[row].reshape(cube), tsdf_m[at])
    return tsdf_m, is_seen


def _crossings(tsdf_m: Float32Array, is_seen: BoolArray) -> BoolArray:
    """Return the voxels (X, Y, Z) with the surface between them and one of their neighbours, on either side."""
    is_site = np.zeros_like(is_seen)
    is_behind = tsdf_m < 0
    for axis in range(3):
        before = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        after = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        crosses = is_seen[before] & is_seen[after] & (is_behind[before] != is_behind[after])
        is_site[before] |= crosses
        is_site[after] |= crosses
    return is_site


def _surface_points(
    tsdf_m: Float32Array, is_seen: BoolArray, is_site: BoolArray, voxel_size_m: float
) -> list[Float32Array]:
    """Return, along each axis, where the surface is that belongs to a site [voxels], on a grid (X, Y, Z)."""
    at = np.nonzero(is_site)
    here = tsdf_m[at].astype(np.float64)
    slopes = np.zeros((3, len(here)))
    for axis in range(3):
        for step in (-1, 1):
            beside = [np.array(a) for a in at]
            beside[axis] = np.clip(beside[axis] + step, 0, tsdf_m.shape[axis] - 1)
            there = tuple(beside)
            slope = step * (tsdf_m[there] - here)
            is_used = is_seen[there] & (np.abs(slope) > np.abs(slopes[axis]))
            slopes[axis] = np.where(is_used, slope, slopes[axis])
    steep = np.linalg.norm(slopes, axis=0)
    normals = np.divide(slopes, steep, out=np.zeros_like(slopes), where=steep > 0)
    away = here / np.maximum(steep, 0.25 * voxel_size_m)  # [voxels] along the normal
    found = []
    for axis in range(3):
        grid = np.zeros(tsdf_m.shape, np.float32)
        grid[at] = at[axis] - np.clip(away, -1, 1) * normals[axis]
        found.append(grid)
    return found


def write_picture(path: Path, field: DistanceField, z_m: float) -> None:
    """Write the slice at a height as a picture.

    Raises:
        MapError: If the slice does not cross the field, or the picture cannot be written.
    """
    image = field.picture(z_m)
    try:
        done, data = cv2.imencode(path.suffix or ".png", image)
        if done:
            write_whole(path, data.tobytes())
    except (OSError, cv2.error) as error:
        raise MapError(f"{path}: the picture could not be written: {error}") from error


def save_field(path: Path, field: DistanceField) -> None:
    """Write a field as numpy's `.npz`: `distance_m`, `state`, `origin_m`, `voxel_size_m`.

    Raises:
        MapError: If the disk refuses.
    """
    names = ("distance_m", "state", "origin_m", "voxel_size_m")
    write_arrays(path, {name: np.asarray(getattr(field, name)) for name in names})


def load_field(path: Path) -> DistanceField:
    """Read a field.

    Raises:
        MapFormatError: If the file is no field, or damaged.
    """
    arrays = read_arrays(path)
    try:
        return DistanceField(
            origin_m=arrays["origin_m"],
            voxel_size_m=float(arrays["voxel_size_m"]),
            distance_m=arrays["distance_m"],
            state=arrays["state"],
        )
    except (KeyError, ValueError, TypeError) as error:
        raise MapFormatError(f"{path}: no field of distances: {error!r}") from error
