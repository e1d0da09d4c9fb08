"""Painted surfaces as triangles, so that LiDARs and cameras see one world."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapstream.recordings.worlds.mesh import Mesh, join
from mapstream.recordings.worlds.surfaces import Surface


def mesh_of(surfaces: Sequence[Surface]) -> Mesh:
    """Return the triangles of all surfaces, as bright as their pictures are on average."""
    return join([_fan(surface) for surface in surfaces])


def _fan(surface: Surface) -> Mesh:
    """Return a convex polygon as triangles around its first corner."""
    num = len(surface.polygon)
    second = np.arange(1, num - 1)
    faces = np.stack([np.zeros_like(second), second, second + 1], axis=1)
    brightness = float(surface.picture.mean()) / 255
    return Mesh(
        vertices=surface.points(surface.polygon),
        faces=faces,
        reflectivity=np.full(len(faces), brightness, np.float32),
    )
