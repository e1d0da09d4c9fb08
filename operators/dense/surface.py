"""The surface of a volume: marching cubes over the cells that it passes through, whichever blocks they are in.

Source: Lorensen and Cline, Marching cubes, SIGGRAPH 1987, with tables that agree on every face between two cells
(docs/decisions/0017-dense-maps.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from mapstream.operators.dense.volume import SIDE, TsdfVolume
from mapstream.recordings.mesh_files import SurfaceMesh, with_normals
from mapstream.streams.arrays import Float32Array, FloatArray, IntArray
from mapstream.streams.errors import MapError

ScalarT = TypeVar("ScalarT", bound=np.generic)

_CORNERS = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]
)  # of a cell, in the order of the tables
_UNSEEN = 128.0  # the grey of what no camera saw
_CHUNK = 2048  # blocks at a time
_BITS = 20  # of a voxel's coordinate on each axis
_HALF = 1 << (_BITS - 1)


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """Cells that the surface passes through; a cell reaches from the middle of one voxel to that of the next."""

    voxels: IntArray  # (C, 8) the voxels at their corners, by number
    distance_m: Float32Array  # (C, 8)
    rgb: Float32Array | None  # (C, 8, 3)


@dataclass(frozen=True, slots=True, eq=False)
class _Piece:
    """A part of the surface; vertices of equal names are one."""

    names: IntArray  # (V,) of the edge between two voxels that a vertex lies on
    vertices: FloatArray  # (V, 3) [voxels]
    faces: IntArray  # (F, 3)
    rgb: FloatArray | None  # (V, 3)


def surface_of(
    volume: TsdfVolume, *, min_weight: float = 0.0, min_part_faces: int = 0
) -> SurfaceMesh:
    """Return the surface where distances change their sign, seen from where they are positive.

    Vertices between two blocks are those of both, so a surface that was seen all round is closed.

    Args:
        volume: With what was integrated.
        min_weight: Voxels of no more weight count as not seen; the surface ends there.
        min_part_faces: Parts of the surface with fewer triangles are left out.

    Raises:
        MapError: If the volume holds no surface.
    """
    pieces = []
    for start in range(0, len(volume), _CHUNK):
        rows = np.arange(start, min(start + _CHUNK, len(volume)))
        cells = _cells(volume, rows, min_weight)
        if len(cells.voxels):
            pieces.append(_marched(cells))
    if not pieces:
        raise MapError(
            f"the volume of {len(volume)} blocks holds no surface; was anything seen within reach, and often enough?"
        )
    names = np.concatenate([piece.names for piece in pieces])
    _, first, at = np.unique(names, return_index=True, return_inverse=True)
    starts = np.cumsum([0, *(len(piece.names) for piece in pieces)])
    faces = np.concatenate([p.faces + s for p, s in zip(pieces, starts[:-1], strict=True)])
    vertices = np.concatenate([piece.vertices for piece in pieces])[first]
    colors = [piece.rgb for piece in pieces if piece.rgb is not None]
    mesh = SurfaceMesh(
        vertices=((vertices + 0.5) * volume.voxel_size_m).astype(np.float32),
        faces=at[faces].astype(np.int32),
        rgb=np.round(np.concatenate(colors)[first]).astype(np.uint8) if colors else None,
    )
    if min_part_faces > 1:
        mesh = without_small_parts(mesh, min_part_faces)
    return with_normals(mesh)


def without_small_parts(mesh: SurfaceMesh, min_faces: int) -> SurfaceMesh:
    """Return the mesh without those of its parts that hang together by fewer triangles."""
    from scipy.sparse import coo_array  # noqa: PLC0415  # scipy takes its time
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    n = len(mesh.vertices)
    ends = mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]]
    a, b = np.concatenate(ends).T
    _, part = connected_components(coo_array((np.ones(len(a), np.int8), (a, b)), (n, n)))
    count = np.bincount(part[mesh.faces[:, 0]], minlength=part.max(initial=0) + 1)
    faces = mesh.faces[count[part[mesh.faces[:, 0]]] >= min_faces]
    if not len(faces):
        raise MapError(
            f"no part of the surface has {min_faces} triangles; use a smaller min_part_faces"
        )
    used, new = np.unique(faces, return_inverse=True)
    return SurfaceMesh(
        vertices=mesh.vertices[used],
        faces=new.reshape(-1, 3).astype(np.int32),
        rgb=None if mesh.rgb is None else mesh.rgb[used],
    )


def _cells(volume: TsdfVolume, rows: IntArray, min_weight: float) -> _Cells:
    """Return the cells that begin in some blocks, and that the surface passes through."""
    is_seen = _with_neighbours(volume, rows, volume.weight > min_weight)
    distance_m = _with_neighbours(volume, rows, volume.distance_m)
    is_whole, is_in, is_out = (np.ones((len(rows), SIDE, SIDE, SIDE), np.bool_) for _ in range(3))
    for corner in _CORNERS.tolist():
        x, y, z = (slice(offset, offset + SIDE) for offset in corner)
        is_whole &= is_seen[:, x, y, z]
        is_in &= distance_m[:, x, y, z] < 0
        is_out &= distance_m[:, x, y, z] >= 0
    block, *place = np.nonzero(is_whole & ~is_in & ~is_out)
    corners = np.stack(place, axis=1)[:, None, :] + _CORNERS  # (C, 8, 3) in their blocks
    inside = block[:, None], *np.moveaxis(corners, 2, 0)
    voxels = volume.blocks[rows[block]][:, None, :] * SIDE + corners
    rgb = None
    if volume.rgb is not None:
        rgb = _with_neighbours(volume, rows, volume.rgb)[inside].astype(np.float32)
    return _Cells(_numbers(voxels), distance_m[inside], rgb)


def _with_neighbours(
    volume: TsdfVolume, rows: IntArray, values: npt.NDArray[ScalarT]
) -> npt.NDArray[ScalarT]:
    """Return the values (B, 9, 9, 9, ...) of blocks and of the next voxels behind them; 0 where there is none."""
    shape = (SIDE, SIDE, SIDE, *values.shape[2:])
    found = np.zeros((len(rows), *(n + 1 for n in shape[:3]), *shape[3:]), values.dtype)
    for step in product((0, 1), repeat=3):
        neighbours = volume.rows_of(volume.blocks[rows] + step)
        there = np.flatnonzero(neighbours >= 0)
        to = tuple(slice(SIDE, None) if s else slice(0, SIDE) for s in step)
        of = tuple(slice(0, 1) if s else slice(None) for s in step)
        blocks = values[neighbours[there]].reshape(-1, *shape)
        found[(there, *to)] = blocks[(slice(None), *of)]
    return found


def _numbers(voxels: IntArray) -> IntArray:
    """Return a number for each voxel (..., 3)."""
    if len(voxels) and np.abs(voxels).max() >= _HALF:
        raise MapError(f"the surface lies beyond {_HALF} voxels from the origin; use larger voxels")
    x, y, z = np.moveaxis(voxels + _HALF, -1, 0)
    numbers: IntArray = (x << (2 * _BITS)) | (y << _BITS) | z
    return numbers


def _voxels_of(numbers: IntArray) -> IntArray:
    mask = (1 << _BITS) - 1
    parts = [numbers >> (2 * _BITS), (numbers >> _BITS) & mask, numbers & mask]
    return np.stack(parts, axis=-1) - _HALF


def _marched(cells: _Cells) -> _Piece:
    """Return the surface inside cells."""
    import igl  # noqa: PLC0415  # takes its time

    numbers, first, at = np.unique(cells.voxels, return_index=True, return_inverse=True)
    distance_m = cells.distance_m.ravel()[first].astype(np.float64)
    places = _voxels_of(numbers)
    vertices, faces, ends_of = igl.marching_cubes(
        distance_m, places.astype(np.float64), at.reshape(cells.voxels.shape), 0.0
    )
    ends = np.fromiter(ends_of.keys(), np.int64, len(ends_of))
    vertex = np.fromiter(ends_of.values(), np.int64, len(ends_of))
    a, b = np.empty((2, len(vertices)), np.int64)
    a[vertex], b[vertex] = ends & 0xFFFFFFFF, ends >> 32
    a, b = np.minimum(a, b), np.maximum(a, b)  # numbers grow with the rows
    axis = np.argmax(places[b] != places[a], axis=1)
    rgb = None
    if cells.rgb is not None:
        of_voxel = cells.rgb.reshape(-1, 3)[first].astype(np.float64)
        share = (distance_m[a] / (distance_m[a] - distance_m[b]))[:, None]
        of_a, of_b = of_voxel[a], of_voxel[b]
        of_a, of_b = np.where(np.isnan(of_a), of_b, of_a), np.where(np.isnan(of_b), of_a, of_b)
        rgb = np.nan_to_num((1 - share) * of_a + share * of_b, nan=_UNSEEN)
    return _Piece(numbers[a] * 3 + axis, vertices, faces, rgb)


def is_closed(mesh: SurfaceMesh) -> bool:
    """Return whether every edge of the mesh joins two triangles that face the same way."""
    f = mesh.faces.astype(np.int64)
    edges = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    there, back = (np.unique(e @ (len(mesh.vertices), 1)) for e in (edges, edges[:, ::-1]))
    return len(there) == len(edges) and np.array_equal(there, back)
