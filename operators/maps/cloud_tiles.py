"""The cloud of a large map as square tiles, so that neither making nor looking needs all of it in memory.

Each tile is a LAZ file; `tiles.json` beside them says where each lies, for programs that load what is in view.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydantic import PositiveFloat

from mapstream.operators.maps.aggregate import AggregateConfig, placed_clouds
from mapstream.operators.maps.geo_clouds import projection_of
from mapstream.operators.maps.voxels import Voxels
from mapstream.recordings.las_files import write_las
from mapstream.recordings.maps.folder import write_whole
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import MapError
from mapstream.streams.messages.estimates import PointCloud

INDEX = "tiles.json"
_ROW = np.dtype([("xyz", "f8", 3), ("intensity", "f4"), ("rgba", "u1", 4)])
_AT_ONCE = 1_000_000  # rows of a tile in memory


class TilesConfig(AggregateConfig):
    """Options of tiles; the voxels are those of each tile."""

    tile_m: PositiveFloat = 50.0
    """Width of a tile."""
    crs: str = "utm"
    """The projection, as of a LAS file: `utm`, EPSG:32632 ..., or `map`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TilesReport:
    """What was written."""

    files: tuple[Path, ...]
    num_points: int
    crs: str  # empty: the map's own axes


def write_tiles(map_: Map, folder: Path, out: Path, config: TilesConfig) -> TilesReport:
    """Write a LAZ file for each square of a map that has points, and the index.

    Points wait on disk, sorted by tile, so memory holds one cloud, and then the voxels of one tile.

    Raises:
        MapError: If the map has no clouds, or a file cannot be written.
    """
    projection = projection_of(map_, config.crs)
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix="tiles-", dir=out) as spool:
        for points_map, cloud in placed_clouds(
            map_, folder, with_unanchored=config.with_unanchored
        ):
            _spool(projection.place(points_map), cloud, Path(spool), config.tile_m)
        waiting = sorted(Path(spool).iterdir())
        entries = [_write_tile(file, out, config, projection.wkt) for file in waiting]
    index = {"crs": projection.crs, "tile_m": config.tile_m, "tiles": entries}
    try:
        write_whole(out / INDEX, json.dumps(index, indent=1, sort_keys=True).encode())
    except OSError as error:
        raise MapError(f"{out / INDEX}: cannot be written: {error}") from error
    files = (out / INDEX, *(out / entry["file"] for entry in entries))
    return TilesReport(
        files=files, num_points=sum(e["num_points"] for e in entries), crs=projection.crs
    )


def _spool(points: FloatArray, cloud: PointCloud, spool: Path, tile_m: float) -> None:
    """Append the points of a cloud to the files of the tiles in which they lie."""
    rows = np.zeros(len(points), _ROW)
    rows["xyz"] = points
    rows["intensity"] = np.nan if cloud.intensity is None else cloud.intensity
    if cloud.colors_rgba is not None:
        rows["rgba"] = cloud.colors_rgba
    tiles, tile = np.unique(
        np.floor(points[:, :2] / tile_m).astype(np.int64), axis=0, return_inverse=True
    )
    for number, (east, north) in enumerate(tiles.tolist()):
        with (spool / f"{east}_{north}").open("ab") as file:
            file.write(rows[tile.ravel() == number].tobytes())


def _write_tile(file: Path, out: Path, config: TilesConfig, wkt: str) -> dict[str, Any]:
    """Write what was spooled for one tile, and return its entry of the index."""
    east, north = (int(number) * config.tile_m for number in file.name.split("_"))
    corner = np.array(
        [east, north, 0.0]
    )  # voxels are counted from here: far places have large numbers
    voxels = Voxels(config.voxel_size_m, config.max_voxels)
    rows = np.memmap(file, _ROW, mode="r")
    for at in range(0, len(rows), _AT_ONCE):
        part = rows[at : at + _AT_ONCE]
        voxels.add(part["xyz"] - corner, part["intensity"], part["rgba"])
    points, intensity, colors = voxels.means()
    name = f"{file.name}.laz"
    has_color, has_intensity = colors[:, 3].any(), np.isfinite(intensity).any()
    write_las(
        out / name,
        points + corner,
        intensity if has_intensity else None,
        colors[:, :3] if has_color else None,
        wkt,
    )
    low, high = points.min(axis=0) + corner, points.max(axis=0) + corner
    return {"file": name, "num_points": len(points), "low": low.tolist(), "high": high.tolist()}
