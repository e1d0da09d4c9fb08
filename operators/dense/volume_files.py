"""Volumes as files: numpy's `.npz` with the blocks that were seen."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from mapstream.operators.dense.volume import VOXELS, TsdfVolume
from mapstream.recordings.maps.folder import write_whole
from mapstream.streams.errors import MapError, MapFormatError


def save_volume(path: Path, volume: TsdfVolume) -> None:
    """Write a volume: `blocks` (B, 3), `distance_m` and `weight` (B, 8, 8, 8), `rgb`, `voxel_size_m`, `truncation_m`.

    Raises:
        MapError: If the disk refuses.
    """
    cubes = (len(volume), 8, 8, 8)
    arrays: dict[str, Any] = {
        "blocks": volume.blocks,
        "distance_m": volume.distance_m.reshape(cubes),
        "weight": volume.weight.reshape(cubes),
        "voxel_size_m": np.float64(volume.voxel_size_m),
        "truncation_m": np.float64(volume.truncation_m),
    }
    if volume.rgb is not None:
        arrays["rgb"] = np.round(np.nan_to_num(volume.rgb)).astype(np.uint8).reshape(*cubes, 3)
    write_arrays(path, arrays)


def load_volume(path: Path, *, max_bytes: int = 2**34) -> TsdfVolume:
    """Read a volume.

    Raises:
        MapError: If it needs more memory than is allowed.
        MapFormatError: If the file is no volume, or damaged.
    """
    arrays = read_arrays(path)
    try:
        size_m, truncation_m = (float(arrays[n]) for n in ("voxel_size_m", "truncation_m"))
        volume = TsdfVolume(size_m, truncation_m, max_bytes, has_colors="rgb" in arrays)
        rows = volume.allocate(arrays["blocks"])
        volume.distance_m[rows] = arrays["distance_m"].reshape(-1, VOXELS)
        volume.weight[rows] = arrays["weight"].reshape(-1, VOXELS)
        if volume.rgb is not None:
            volume.rgb[rows] = arrays["rgb"].reshape(-1, VOXELS, 3)
    except (KeyError, ValueError, TypeError) as error:
        raise MapFormatError(f"{path}: no volume of distances: {error!r}") from error
    return volume


def write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    """Write arrays by name, whole or not at all.

    Raises:
        MapError: If the disk refuses.
    """
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    try:
        write_whole(path, buffer.getbuffer())
    except OSError as error:
        raise MapError(f"{path}: could not be written: {error}") from error


def read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Read arrays by name.

    Raises:
        MapFormatError: If the file is not there or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as found:
            return {name: found[name] for name in found.files}
    except (OSError, EOFError, ValueError, BadZipFile, AttributeError) as error:
        raise MapFormatError(f"{path}: expected arrays of numpy (.npz): {error}") from error
