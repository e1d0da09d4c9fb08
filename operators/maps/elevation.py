"""Height and colour of the ground, as grids that geographic programs read.

A grid is a TIFF or PNG with a world file beside it (`.tfw`, `.pgw`: six numbers, the size of a cell and where
the first one lies), and the projection in a `.prj`, where the map has a place on Earth.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field, NonNegativeInt, PositiveFloat

from mapstream.operators.maps.aggregate import AggregateConfig, aggregate_cloud
from mapstream.operators.maps.geo_clouds import projection_of
from mapstream.recordings.maps.folder import write_whole
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.errors import ConfigError, MapError

_MAX_CELLS = 400_000_000
_WORLD_SUFFIXES = {".tif": ".tfw", ".tiff": ".tfw", ".png": ".pgw"}


class ElevationConfig(AggregateConfig):
    """Options of elevation maps and orthomosaics."""

    cell_m: PositiveFloat = 0.5
    """Width of a cell."""
    surface: Literal["ground", "top"] = "ground"
    """What the height is of: the ground below plants and cars, or what a bird would sit on."""
    ground_share: float = Field(default=0.1, ge=0.0, le=0.5)
    """So much of a cell's points may lie below its ground: noise and mirrors."""
    fill_cells: NonNegativeInt = 2
    """Holes are filled up to so many cells from what was seen."""
    crs: str = "utm"
    """The projection, as of a LAS file: `utm`, EPSG:32632 ..., or `map`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Elevation:
    """A grid of heights; row 0 is the northernmost, as in pictures."""

    heights_m: Float32Array  # (H, W); NaN where nothing was seen
    colors_rgba: npt.NDArray[
        np.uint8
    ]  # (H, W, 4) of what is on top; alpha 0 where no camera looked
    west_m: float  # the outer edge of column 0
    north_m: float  # the outer edge of row 0
    cell_m: float
    wkt: str = ""  # of the projection; empty: the map's own axes


def elevation(map_: Map, folder: Path, config: ElevationConfig) -> Elevation:
    """Return the heights below the clouds of all keyframes.

    Raises:
        MapError: If the map has no clouds, or is too large for cells of this size.
    """
    cloud = aggregate_cloud(map_, folder, config)
    projection = projection_of(map_, config.crs)
    points = projection.place(cloud.points.astype(np.float64))
    return elevation_of(points, cloud.colors_rgba, config, projection.wkt)


def elevation_of(
    points: FloatArray,
    colors_rgba: npt.NDArray[np.uint8] | None,
    config: ElevationConfig,
    wkt: str = "",
) -> Elevation:
    """Return the heights of points (N, 3) [m]: east, north, up.

    Raises:
        MapError: If the points span too many cells.
    """
    cell_m = config.cell_m
    low, high = (
        np.floor(points[:, :2].min(axis=0) / cell_m),
        np.floor(points[:, :2].max(axis=0) / cell_m),
    )
    width, height = (high - low).astype(int) + 1
    if width * height > _MAX_CELLS:
        raise MapError(f"{width} x {height} cells of {cell_m} m are too many; use a larger cell_m")
    column, row = (np.floor(points[:, :2] / cell_m) - low).astype(np.int64).T
    cell = (height - 1 - row) * width + column
    order = np.lexsort((points[:, 2], cell))
    cells, starts, counts = np.unique(cell[order], return_index=True, return_counts=True)
    highest = order[starts + counts - 1]
    share = config.ground_share if config.surface == "ground" else 1.0
    chosen = order[starts + np.round(share * (counts - 1)).astype(np.int64)]
    heights = np.full(height * width, np.nan, np.float32)
    heights[cells] = points[chosen, 2]
    colors = np.zeros((height * width, 4), np.uint8)
    if colors_rgba is not None:
        colors[cells] = colors_rgba[highest]
    return Elevation(
        heights_m=_filled(heights.reshape(height, width), config.fill_cells),
        colors_rgba=colors.reshape(height, width, 4),
        west_m=float(low[0] * cell_m),
        north_m=float((high[1] + 1) * cell_m),
        cell_m=cell_m,
        wkt=wkt,
    )


def _filled(heights_m: Float32Array, reach_cells: int) -> Float32Array:
    """Return the grid with holes filled from the known cells around, nearer ones counting more."""
    if not reach_cells or not np.isnan(heights_m).any():
        return heights_m
    known = np.isfinite(heights_m)
    size = 2 * reach_cells + 1
    weights = cv2.GaussianBlur(known.astype(np.float32), (size, size), reach_cells / 2)
    sums = cv2.GaussianBlur(
        np.where(known, heights_m, np.float32(0)), (size, size), reach_cells / 2
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        around = np.where(weights > 1e-6, sums / weights, np.nan)
    filled: Float32Array = np.where(known, heights_m, around).astype(np.float32)
    return filled


def write_elevation(grid: Elevation, path: Path) -> tuple[Path, ...]:
    """Write the heights [m] as a TIFF of float32 numbers, NaN where nothing was seen; return the files.

    Raises:
        ConfigError: If the suffix is not that of a TIFF.
        MapError: If a file cannot be written.
    """
    if path.suffix.lower() not in (".tif", ".tiff"):
        raise ConfigError(f"{path}: heights go into a .tif, not {path.suffix!r}")
    return _write(grid, path, grid.heights_m)


def write_orthomosaic(grid: Elevation, path: Path) -> tuple[Path, ...]:
    """Write the colours seen from above as PNG or TIFF, transparent where no camera looked; return the files.

    Raises:
        ConfigError: If the suffix is another one.
        MapError: If no camera gave the clouds colours, or a file cannot be written.
    """
    if path.suffix.lower() not in _WORLD_SUFFIXES:
        raise ConfigError(f"{path}: an orthomosaic is a .png or .tif, not {path.suffix!r}")
    if not grid.colors_rgba[..., 3].any():
        raise MapError(
            "the map's clouds have no colours; put `cloud_colors` before the keyframes (preset lidar_camera)"
        )
    return _write(grid, path, np.ascontiguousarray(grid.colors_rgba[..., [2, 1, 0, 3]]))


def _write(grid: Elevation, path: Path, image: npt.NDArray[Any]) -> tuple[Path, ...]:
    half = grid.cell_m / 2
    numbers = (grid.cell_m, 0.0, 0.0, -grid.cell_m, grid.west_m + half, grid.north_m - half)
    files = {
        path: cv2.imencode(path.suffix.lower(), image)[1].tobytes(),
        path.with_suffix(_WORLD_SUFFIXES[path.suffix.lower()]): "".join(
            f"{n:.9f}\n" for n in numbers
        ).encode(),
    }
    if grid.wkt:
        files[path.with_suffix(".prj")] = grid.wkt.encode()
    try:
        for file, content in files.items():
            write_whole(file, content)
    except OSError as error:
        raise MapError(f"{path}: cannot be written: {error}") from error
    return tuple(files)
