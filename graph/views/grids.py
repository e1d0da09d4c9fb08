"""Occupancy grids, lying on the ground of the map."""

from __future__ import annotations

import numpy as np
import rerun as rr

from mapstream.graph.views.scene import MAP, Drawing, Entry, Scene
from mapstream.streams.messages.grids import UNKNOWN, OccupancyGrid

_BELOW_M = 0.02  # under what else is drawn at the ground
_MAX_SIDE = 4096  # pixels of a picture; larger grids are drawn more coarsely
_TEXTURE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)


def view_occupancy_grid(grid: OccupancyGrid, scene: Scene) -> Drawing:
    """Draw the cells as a picture: dark where something stands, light where it is free, clear where nobody knows."""
    rows, columns = grid.cells.shape
    step = max(1, -(-max(rows, columns) // _MAX_SIDE))
    cells = grid.cells[::step, ::step]
    shade = np.rint(245 - 2.3 * np.clip(cells, 0, 100)).astype(np.uint8)
    opacity = np.where(cells == UNKNOWN, 0, 255).astype(np.uint8)
    corners = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]]) * grid.resolution_m
    ground = np.column_stack([corners, np.full(4, -_BELOW_M)])
    picture = rr.Mesh3D(
        vertex_positions=(grid.T_map_grid @ ground).astype(np.float32),
        triangle_indices=[[0, 1, 2], [0, 2, 3]],
        vertex_texcoords=_TEXTURE,
        albedo_texture=np.dstack([shade, shade, shade, opacity]),
    )
    occupied = float((grid.cells > 50).sum() * grid.resolution_m**2)
    free = float(((grid.cells >= 0) & (grid.cells < 50)).sum() * grid.resolution_m**2)
    return [
        *scene.within("", MAP, picture),
        Entry.of("free_m2", rr.Scalars([free])),
        Entry.of("occupied_m2", rr.Scalars([occupied])),
    ]
