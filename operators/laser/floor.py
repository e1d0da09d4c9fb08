"""What planar scans are compared with to find a robot: the surfaces of a finished map, or of a grid."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from mapstream.operators.laser.correlative import Basin, LikelihoodGrid, Window
from mapstream.operators.laser.matching import LineTarget
from mapstream.operators.laser.planar import flattened
from mapstream.operators.laser.recent_scans import first_in_cells
from mapstream.operators.laser.surfaces import Surface, surface_of_cloud
from mapstream.operators.laser.walls import Walls
from mapstream.recordings.cloud_store import read_cloud
from mapstream.recordings.grid_files import is_grid_file, read_grid
from mapstream.recordings.maps import load_map
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import MapError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.grids import OCCUPIED, UNKNOWN, OccupancyGrid

_OCCUPIED_FROM = 65  # percent
_BLUR_CELLS = 1.5  # over which the side of the free space is looked for
_LEAST_SLOPE = 0.05
_MIN_POINTS = 50
_WALL_M = 0.05  # cells of the walls that beams do not pass
_RESOLUTION_M = 0.1  # of the search, whose poses are refined
_TURN_STEP_RAD = float(np.radians(2.5))
_MAX_SIDE = 4000  # cells of the search; larger floors are searched more coarsely
_NUM_LEVELS = 5  # blocks of 32 x 32 poses at first


@dataclass(frozen=True, eq=False)
class Floor:
    """Surfaces in the plane of a map."""

    surface: Surface

    @cached_property
    def target(self) -> LineTarget:
        """Return the surfaces, for matching near a guess."""
        return LineTarget(self.surface)

    @cached_property
    def _likelihood(self) -> LikelihoodGrid:
        points = self.surface.points
        resolution_m = max(_RESOLUTION_M, float(np.ptp(points, axis=0).max()) / _MAX_SIDE)
        sigma_m = 1.5 * resolution_m
        return LikelihoodGrid(
            points, resolution_m=resolution_m, sigma_m=sigma_m, num_levels=_NUM_LEVELS
        )

    def basins(self, points: FloatArray, least_score: float, within: float) -> Iterator[Basin]:
        """Yield the likeliest poses of points (N, 2) on the floor, in any direction; see `LikelihoodGrid.basins`."""
        low, high = self.surface.points.min(axis=0), self.surface.points.max(axis=0)
        middle = np.append((low + high) / 2, 0.0)
        radius_m = float((high - low).max()) / 2
        window = Window(radius_m=radius_m, turn_rad=np.pi, turn_step_rad=_TURN_STEP_RAD)
        return self._likelihood.basins(points, middle, window, least_score, within)

    @cached_property
    def walls(self) -> Walls:
        """Return what no beam can have passed."""
        return Walls(self.surface, _WALL_M)


def open_floor(path: Path, cell_m: float = 0.05) -> Floor:
    """Return the floor of a grid's YAML file, or of a map's folder with clouds of planar lasers.

    Args:
        path: The file or the folder.
        cell_m: One point of the map's clouds is taken in each cell.

    Raises:
        RecordingError: If the file is no grid.
        MapError: If the map has no such clouds, or there is next to nothing in it.
    """
    if is_grid_file(path):
        floor = Floor(grid_surface(read_grid(path)))
    else:
        floor = Floor(_map_surface(load_map(path), path, cell_m))
    if len(floor.surface) < _MIN_POINTS:
        raise MapError(f"{path}: {len(floor.surface)} points on walls are too few to be found by")
    return floor


def grid_surface(grid: OccupancyGrid) -> Surface:
    """Return the occupied cells of a grid, each with the direction in which free space lies."""
    is_free = (grid.cells != UNKNOWN) & (grid.cells < OCCUPIED / 2)
    soft = cv2.GaussianBlur(
        is_free.astype(np.float32), (0, 0), _BLUR_CELLS, borderType=cv2.BORDER_CONSTANT
    )
    slope_y, slope_x = np.gradient(soft)
    rows, columns = np.nonzero(grid.cells >= _OCCUPIED_FROM)
    slopes = np.stack([slope_x, slope_y], axis=-1)[rows, columns].astype(np.float64)
    steepness = np.linalg.norm(slopes, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals = slopes / steepness[:, None]
    normals[steepness < _LEAST_SLOPE] = np.nan
    middles = (np.stack([columns, rows], axis=1) + 0.5).astype(np.float64) * grid.resolution_m
    return Surface(middles, normals).moved(flattened(grid.T_map_grid))


def _map_surface(map_: Map, folder: Path, cell_m: float) -> Surface:
    """Return what the clouds of all keyframes of known place show, one point per cell."""
    resources = map_.resources
    rows = np.flatnonzero((resources.kind == "cloud") & (resources.topic == ""))
    mission = map_.vertices.mission[resources.vertex[rows]]
    rows = rows[map_.missions.is_base_frame_known[mission]]
    if not len(rows):
        raise MapError(f"{folder}: there are no clouds of missions whose place is known")
    surfaces = []
    for row, T_map_base in zip(rows.tolist(), map_.T_map_base(resources.vertex[rows]), strict=True):
        points = read_cloud(folder / resources.path[row]).points[:, :2].astype(np.float64)
        seen = _facing_the_base(surface_of_cloud(points[first_in_cells(points, cell_m)]))
        surfaces.append(seen.lined().moved(flattened(SE3(T_map_base))))
    points = np.concatenate([surface.points for surface in surfaces])
    normals = np.concatenate([surface.normals for surface in surfaces])
    kept = first_in_cells(points, cell_m)
    return Surface(points[kept], normals[kept])


def _facing_the_base(surface: Surface) -> Surface:
    """Return a surface around the base with sides: those from which it was seen."""
    is_away = np.einsum("nc,nc->n", surface.normals, surface.points) > 0
    turned = np.where(is_away[:, None], -surface.normals, surface.normals)
    return replace(surface, normals=turned, has_sides=True)
