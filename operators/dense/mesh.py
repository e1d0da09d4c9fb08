"""A map's surface as a mesh in a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pydantic import NonNegativeFloat, NonNegativeInt

from mapstream.operators.dense.fusion import FusionConfig, FusionReport, Progress, fuse
from mapstream.operators.dense.surface import surface_of
from mapstream.recordings.maps.model import Map
from mapstream.recordings.mesh_files import check_mesh_path, write_mesh


class MeshConfig(FusionConfig):
    """What is fused, and which of its surface is kept."""

    min_weight: NonNegativeFloat = 0.0
    """Voxels of no more weight count as not seen; a depth image weighs 1 at 1 m and 1/16 at 4 m, a point of a cloud 1."""
    min_part_faces: NonNegativeInt = 100
    """Parts of the surface with fewer triangles are left out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshReport:
    """What was fused and written."""

    fused: FusionReport
    num_vertices: int
    num_faces: int


def make_mesh(
    map_: Map,
    folder: Path,
    path: Path,
    config: MeshConfig,
    on_progress: Progress = lambda _: None,
) -> MeshReport:
    """Fuse what a map saw, and write the surface as `.ply` or `.glb`, in the map frame.

    Raises:
        MapError: If there is nothing to fuse or no surface, or it needs more memory than is allowed.
        RecordingError: If a recording is not there, or the file cannot be written.
    """
    check_mesh_path(path)
    volume, fused = fuse(map_, folder, config, on_progress=on_progress)
    mesh = surface_of(volume, min_weight=config.min_weight, min_part_faces=config.min_part_faces)
    write_mesh(path, mesh)
    return MeshReport(fused=fused, num_vertices=len(mesh.vertices), num_faces=len(mesh.faces))
