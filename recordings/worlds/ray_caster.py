"""Rays against triangles: the one door to libigl.

Only `igl` itself is imported, which is MPL-2.0; `igl.copyleft` in the same wheel never is
(docs/decisions/0002-ray-caster.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np

from mapstream.recordings.worlds.mesh import Mesh
from mapstream.streams.messages.sensors import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What each ray met first."""

    ranges_m: FloatArray  # (N,) inf where a ray met nothing
    faces: IntArray  # (N,) -1 where a ray met nothing


class RayCaster:
    """A mesh with its tree of bounding boxes; answers are the same with any number of threads."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.normals = mesh.normals()
        self._tree = igl.AABB()
        self._tree.init(mesh.vertices, mesh.faces)

    def cast(self, origins: FloatArray, directions: FloatArray) -> Hits:
        """Return the nearest hit of each ray; origins and unit directions are (N, 3) [m]."""
        faces, ranges_m, _ = self._tree.intersect_ray_first(
            self.mesh.vertices, self.mesh.faces, origins, directions
        )
        return Hits(np.where(faces < 0, np.inf, ranges_m), faces)
