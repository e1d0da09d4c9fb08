"""Rays against triangles: the one door to libigl.

Only `igl` itself is imported, which is MPL-2.0; `igl.copyleft` in the same wheel never is
(docs/decisions/0002-ray-caster.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np

from mapstream.recordings.worlds.mesh import Mesh
from mapstream.streams.arrays import FloatArray, IntArray

_REACH_M = 12.0  # of the trees of what is near
_SLACK_M = np.array([2.0, 2.0, 0.2])  # how far origins may move; robots drive on floors


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What each ray met first."""

    ranges_m: FloatArray  # (N,) inf where a ray met nothing
    faces: IntArray  # (N,) -1 where a ray met nothing


class RayCaster:
    """A mesh with trees of bounding boxes; answers are the same with any number of threads.

    Most rays end near by, and none sees what lies behind it. So around the origins, as long as they stay
    in a box, there is a small tree for each of the eight octants of directions; the few rays that find
    nothing in it within its reach go on to the tree of all.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.normals = mesh.normals()
        corners = mesh.vertices[mesh.faces]
        self._low, self._high = corners.min(axis=1), corners.max(axis=1)
        self._all = _Tree(mesh, np.arange(len(mesh.faces)))
        self._box = np.full((2, 3), np.nan)  # least and greatest origin that the octants are for
        self._octants: list[_Tree] = []

    def cast(self, origins: FloatArray, directions: FloatArray) -> Hits:
        """Return the nearest hit of each ray; origins and unit directions are (N, 3) [m]."""
        low, high = origins.min(axis=0), origins.max(axis=0)
        if not ((low >= self._box[0]).all() and (high <= self._box[1]).all()):
            self._gather(low - _SLACK_M, high + _SLACK_M)
        ranges_m, faces = np.full(len(origins), np.inf), np.full(len(origins), -1)
        octants = (directions > 0) @ (1, 2, 4)
        for number, tree in enumerate(self._octants):
            rays = np.flatnonzero(octants == number)
            ranges_m[rays], faces[rays] = tree.cast(origins[rays], directions[rays])
        rays = np.flatnonzero(ranges_m > _REACH_M)
        ranges_m[rays], faces[rays] = self._all.cast(origins[rays], directions[rays])
        return Hits(ranges_m, faces)

    def _gather(self, low: FloatArray, high: FloatArray) -> None:
        """Make the trees for rays that begin in a box."""
        self._box = np.stack([low, high])
        beyond = np.maximum(np.maximum(self._low - high, low - self._high), 0.0)
        near = np.flatnonzero(np.einsum("ij,ij->i", beyond, beyond) <= _REACH_M**2)
        is_ahead = self._high[near] >= low, self._low[near] <= high  # along each axis, against it
        self._octants = []
        for number in range(8):
            x, y, z = (is_ahead[not number & bit][:, axis] for axis, bit in enumerate((1, 2, 4)))
            self._octants.append(_Tree(self.mesh, near[x & y & z]))


class _Tree:
    """Bounding boxes around some faces of a mesh."""

    def __init__(self, mesh: Mesh, rows: IntArray) -> None:
        self._vertices, self._faces, self._rows = mesh.vertices, mesh.faces[rows], rows
        self._boxes = igl.AABB()
        self._boxes.init(self._vertices, self._faces)

    def cast(self, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, IntArray]:
        """Return ranges (N,) and faces (N,) of the mesh."""
        if not len(self._rows) or not len(origins):
            return np.full(len(origins), np.inf), np.full(len(origins), -1)
        found, ranges_m, _ = self._boxes.intersect_ray_first(
            self._vertices, self._faces, origins, directions
        )
        missed = found < 0
        return np.where(missed, np.inf, ranges_m), np.where(missed, -1, self._rows[found])
