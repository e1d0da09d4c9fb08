"""The occupancy grid of a map: the clouds of its keyframes, where its poses put them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import PositiveFloat

from mapstream.operators.laser.odds_grid import OddsConfig, OddsGrid
from mapstream.operators.laser.sight import rays_of
from mapstream.operators.maps.aggregate import placed_cloud_rows
from mapstream.recordings.cloud_store import read_cloud
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.records import recorded
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import DecodeError, RecordingError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.grids import FREE, UNKNOWN, OccupancyGrid


class GridConfig(OddsConfig):
    """What becomes a grid, and how."""

    min_height_m: float = 0.1
    """Over the base, of what stands in the robot's way; clouds that are flat are taken whole."""
    max_height_m: float = 1.5
    max_range_m: PositiveFloat = 20.0
    """Of beams; what is farther says only that the way there is free."""
    sensor_xyz_m: tuple[float, float, float] | None = None
    """Where beams begin, in the base frame; null: as the recording says, else at the base."""
    with_unanchored: bool = False
    """Also missions whose place in the map is a guess."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GridReport:
    """What came of it."""

    num_clouds: int
    columns: int
    rows: int
    free_m2: float
    occupied_cells: int
    knows_sensors: bool  # where beams began is known, not guessed

    def lines(self) -> list[str]:
        """Return what to tell people."""
        guessed = "" if self.knows_sensors else "; beams were taken to begin at the base"
        size = f"{self.columns} x {self.rows} cells of {self.num_clouds} clouds"
        return [
            f"{size}: {self.free_m2:.1f} m2 free, {self.occupied_cells} cells occupied{guessed}"
        ]


def map_grid(
    map_: Map, folder: Path, config: GridConfig | None = None
) -> tuple[OccupancyGrid, GridReport]:
    """Return the floor plan in the map frame, one cloud after another.

    Args:
        map_: The map.
        folder: Of the clouds.
        config: See there.

    Raises:
        MapError: If the map has no clouds, one is missing, or the grid would be too large.
    """
    config = config or GridConfig()
    rows = placed_cloud_rows(map_, folder, with_unanchored=config.with_unanchored)
    vertices = map_.resources.vertex[rows]
    origins = None if config.sensor_xyz_m else _recorded_origins(map_, vertices)
    given = np.array(config.sensor_xyz_m or (0.0, 0.0, 0.0))
    odds = OddsGrid(config)
    poses = map_.T_map_base(vertices)
    for at, (row, T_map_base) in enumerate(zip(rows.tolist(), poses, strict=True)):
        points = read_cloud(folder / map_.resources.path[row]).points.astype(np.float64)
        origin = given if origins is None else origins[at]
        band_m = (config.min_height_m, config.max_height_m)
        odds.add(rays_of(points, origin, T_map_base, band_m, config.max_range_m))
    grid = odds.grid(map_.stamp_ns)
    return grid, GridReport(
        num_clouds=len(rows),
        columns=grid.cells.shape[1],
        rows=grid.cells.shape[0],
        free_m2=float(((grid.cells < 50) & (grid.cells >= FREE)).sum() * grid.resolution_m**2),
        occupied_cells=int(((grid.cells >= 50) & (grid.cells != UNKNOWN)).sum()),
        knows_sensors=origins is not None or config.sensor_xyz_m is not None,
    )


def _recorded_origins(map_: Map, vertices: IntArray) -> FloatArray | None:
    """Return where the beams of each vertex began (N, 3), by the first record of each topic; None if nobody says."""
    resources = map_.resources
    rows = np.flatnonzero((resources.kind == "record") & np.isin(resources.vertex, vertices))
    sources = [*zip(resources.path[rows].tolist(), resources.topic[rows].tolist(), strict=True)]
    firsts = dict(zip(reversed(sources), reversed(rows.tolist()), strict=True))
    try:
        messages = recorded(map_, np.array(sorted(firsts.values()), np.int64))
        found = {(str(resources.path[row]), str(resources.topic[row])): m for row, m in messages}
    except (RecordingError, DecodeError):
        return None
    place = {
        key: T.t
        for key, message in found.items()
        if isinstance(T := getattr(message, "T_base_sensor", None), SE3)
    }
    of_vertex = {
        int(resources.vertex[row]): place[source]
        for row, source in zip(rows.tolist(), sources, strict=True)
        if source in place
    }
    if any(vertex not in of_vertex for vertex in vertices.tolist()):
        return None
    return np.array([of_vertex[vertex] for vertex in vertices.tolist()])
