"""Triangle meshes with a reflectivity per face: what synthetic worlds are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mapstream.streams.arrays import Float32Array, FloatArray, IntArray, frozen
from mapstream.streams.geometry import SE3

_BOX_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
_BOX_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5]),
        *([0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6]),
        *([0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mesh:
    """Triangles in the world frame."""

    vertices: FloatArray  # (V, 3) [m]
    faces: IntArray  # (F, 3) rows of vertices
    reflectivity: Float32Array  # (F,) 0 black, 1 white

    def __post_init__(self) -> None:
        frozen(self, "vertices", np.float64, (None, 3))
        n = frozen(self, "faces", np.int64, (None, 3)).shape[0]
        frozen(self, "reflectivity", np.float32, (n,))

    def normals(self) -> FloatArray:
        """Return the unit normals (F, 3) of the faces."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        normals = np.cross(b - a, c - a)
        unit: FloatArray = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        return unit


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Put meshes side by side."""
    counts = [len(mesh.vertices) for mesh in meshes]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate([m.faces + s for m, s in zip(meshes, starts, strict=True)]),
        reflectivity=np.concatenate([mesh.reflectivity for mesh in meshes]),
    )


def box(T_world_box: SE3, size_m: npt.ArrayLike, reflectivity: float) -> Mesh:
    """Return a box of length, width and height `size_m` around the origin of its frame."""
    return Mesh(
        vertices=T_world_box @ (_BOX_CORNERS * np.asarray(size_m, dtype=np.float64)),
        faces=_BOX_FACES,
        reflectivity=np.full(len(_BOX_FACES), reflectivity, dtype=np.float32),
    )


def sheet(points: FloatArray, reflectivity: Float32Array) -> Mesh:
    """Return the surface through a grid of points.

    Args:
        points: Shape (M, N, 3) [m].
        reflectivity: Shape (M - 1, N - 1), of the cells; each becomes two triangles.
    """
    rows, columns = points.shape[:2]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + columns], axis=1)
    upper = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=1)
    return Mesh(
        vertices=points.reshape(-1, 3),
        faces=np.concatenate([lower, upper]),
        reflectivity=np.tile(reflectivity.ravel(), 2),
    )
