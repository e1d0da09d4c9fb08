"""Surfaces as files of other programs: PLY, and GLB (binary glTF 2.0); trimesh writes and reads them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mapstream.recordings.maps.folder import write_whole
from mapstream.streams.arrays import Float32Array, frozen, frozen_optional
from mapstream.streams.errors import RecordingError

if TYPE_CHECKING:
    import trimesh

SUFFIXES = (".ply", ".glb")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurfaceMesh:
    """Triangles whose corners run counter-clockwise as seen from outside."""

    vertices: Float32Array  # (V, 3) [m]
    faces: npt.NDArray[np.int32]  # (F, 3) rows of vertices
    normals: Float32Array | None = None  # (V, 3) unit
    rgb: npt.NDArray[np.uint8] | None = None  # (V, 3)

    def __post_init__(self) -> None:
        n = frozen(self, "vertices", np.float32, (None, 3)).shape[0]
        faces = frozen(self, "faces", np.int32, (None, 3))
        frozen_optional(self, "normals", np.float32, (n, 3))
        frozen_optional(self, "rgb", np.uint8, (n, 3))
        if len(faces) and not (faces.min() >= 0 and faces.max() < n):
            raise ValueError(f"SurfaceMesh: faces name vertices up to {faces.max()}, of {n}")


def with_normals(mesh: SurfaceMesh) -> SurfaceMesh:
    """Return the mesh with normals at its vertices: those of the triangles around, by their areas."""
    corners = mesh.vertices.astype(np.float64)[mesh.faces]
    of_face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    at, n = mesh.faces.ravel(), len(mesh.vertices)
    sums = np.stack(
        [np.bincount(at, np.repeat(of_face[:, axis], 3), minlength=n) for axis in range(3)], axis=1
    )
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    normals = np.divide(sums, length, out=np.zeros_like(sums), where=length > 0)
    return replace(mesh, normals=normals.astype(np.float32))


def check_mesh_path(path: Path) -> None:
    """Refuse a name whose suffix is of no known format.

    Raises:
        RecordingError: With those that are known.
    """
    if path.suffix.lower() not in SUFFIXES:
        known = ", ".join(SUFFIXES)
        raise RecordingError(f"{path}: unknown format {path.suffix!r} of a mesh; known are {known}")


def write_mesh(path: Path, mesh: SurfaceMesh) -> None:
    """Write a mesh as its suffix says, whole or not at all.

    GLB has y upwards and metres by its specification, so the map's z becomes its y.

    Raises:
        RecordingError: If the suffix is of no known format, or the disk refuses.
    """
    check_mesh_path(path)
    written: Any = _as_trimesh(mesh)
    options = {"vertex_normal": mesh.normals is not None}
    if path.suffix.lower() == ".glb":
        written.apply_transform(_Y_UP)
        options = {"include_normals": mesh.normals is not None}
    data = written.export(file_type=path.suffix.lower()[1:], **options)
    try:
        write_whole(path, data)
    except OSError as error:
        raise RecordingError(f"{path}: the mesh could not be written: {error}") from error


def read_mesh(path: Path) -> SurfaceMesh:
    """Read a mesh of `.ply` or `.glb`, without normals; of a GLB the map's axes are restored.

    Raises:
        RecordingError: If it cannot be read, or holds no triangles.
    """
    import trimesh  # noqa: PLC0415  # takes its time

    check_mesh_path(path)
    try:
        found: Any = trimesh.load_mesh(path, process=False)
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        raise RecordingError(f"{path}: the mesh cannot be read: {error}") from error
    if not isinstance(found, trimesh.Trimesh) or not len(found.faces):
        raise RecordingError(f"{path}: expected a mesh of triangles, found none")
    if path.suffix.lower() == ".glb":
        found.apply_transform(_Y_UP.T)
    visual: Any = found.visual
    has_colors = visual.kind == "vertex"
    return SurfaceMesh(
        vertices=np.asarray(found.vertices, np.float32),
        faces=np.asarray(found.faces, np.int32),
        rgb=np.asarray(visual.vertex_colors)[:, :3] if has_colors else None,
    )


_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def _as_trimesh(mesh: SurfaceMesh) -> trimesh.Trimesh:
    import trimesh  # noqa: PLC0415  # takes its time

    return trimesh.Trimesh(
        vertices=np.array(mesh.vertices, np.float64),
        faces=np.array(mesh.faces, np.int64),
        vertex_normals=None if mesh.normals is None else np.array(mesh.normals, np.float64),
        vertex_colors=None if mesh.rgb is None else np.array(mesh.rgb),
        process=False,
    )
