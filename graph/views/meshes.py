"""Surfaces of maps."""

from __future__ import annotations

import rerun as rr

from mapstream.graph.views.growing import MAP_PATH
from mapstream.graph.views.scene import Entry
from mapstream.recordings.mesh_files import SurfaceMesh, with_normals


def mesh_entry(mesh: SurfaceMesh) -> Entry:
    """Draw a surface in the map frame, with its colours if it has any."""
    shaded = mesh if mesh.normals is not None else with_normals(mesh)
    drawn = rr.Mesh3D(
        vertex_positions=shaded.vertices,
        triangle_indices=shaded.faces.astype("uint32"),
        vertex_normals=shaded.normals,
        vertex_colors=shaded.rgb,
    )
    return Entry.of(f"{MAP_PATH}/mesh", drawn)
