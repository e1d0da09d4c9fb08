"""Planes within their outlines: seen at the moment, measured, and kept in a map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from mapstream.graph.views.colors import ColorArray
from mapstream.graph.views.scene import BASE, Drawing, Entry, Scene
from mapstream.recordings.maps.hulls import hull_of
from mapstream.streams.arrays import FloatArray
from mapstream.streams.messages.constraints import Constraint
from mapstream.streams.messages.planes import PlaneSegments

PLANE = 0x56B4E9FF
_OPACITY = 0x40  # one sees through surfaces
_SEEN = (0xE69F00FF, 0x2FD6A3FF, 0xF0E442FF, 0xE56AB3FF, 0x56B4E9FF, 0xFF7043FF)  # by number
_NORMAL_M = 0.2


def view_plane_segments(planes: PlaneSegments, scene: Scene) -> Drawing:
    """Draw what is seen around the robot: outlines, surfaces and normals; plot how many there are."""
    colors = np.array([_SEEN[row % len(_SEEN)] for row in range(len(planes))], np.uint32)
    boundaries, surface = drawn(planes.T_base_plane, planes.hulls_m, colors)
    normals = rr.Arrows3D(
        origins=planes.T_base_plane[:, :3, 3],
        vectors=_NORMAL_M * planes.T_base_plane[:, :3, 2],
        colors=colors,
        radii=rr.Radius.ui_points(1.5),
    )
    return [
        *scene.within("", BASE, boundaries),
        *scene.within("surface", BASE, surface),
        *scene.within("normals", BASE, normals),
        Entry.of("num_planes", rr.Scalars([len(planes)])),
    ]


def view_plane_constraint(constraint: Constraint, scene: Scene) -> Drawing:
    """Draw the planes that were recognised at one moment, with their names, around the robot."""
    seen: list[Constraint] = scene.of_moment("recognised", constraint.stamp_ns, constraint)
    names = [each.landmark.name if each.landmark else "plane" for each in seen]
    hulls = [hull_of(each.payload) for each in seen]
    poses = np.array([each.T_a_b.matrix for each in seen])
    boundaries, _ = drawn(poses, hulls, [PLANE] * len(seen), names)
    return scene.within("", BASE, boundaries)


def drawn(
    T: FloatArray,
    hulls_m: Sequence[FloatArray],
    colors: ColorArray | Sequence[int],
    labels: Sequence[str] = (),
) -> tuple[rr.LineStrips3D, rr.Mesh3D]:
    """Return the outlines of planes and their surfaces, which are convex; a line has no surface.

    Args:
        T: Poses (N, 4, 4) on the planes.
        hulls_m: N of (K, 2).
        colors: N, with opacity.
        labels: N, or none.
    """
    strips, triangles, shades, first = [], [], [], 0
    for pose, hull, color in zip(T, hulls_m, map(int, colors), strict=True):
        corners = hull @ pose[:3, :2].T + pose[:3, 3]
        strips.append(np.concatenate([corners, corners[:1]]).astype(np.float32))
        fan = np.arange(1, max(len(corners) - 1, 1))
        triangles.append(first + np.column_stack([np.zeros_like(fan), fan, fan + 1]))
        shades.append(np.full(len(corners), (color & 0xFFFFFF00) | _OPACITY, np.uint32))
        first += len(corners)
    vertices = [strip[:-1] for strip in strips]
    surface = rr.Mesh3D(
        vertex_positions=np.concatenate([np.empty((0, 3), np.float32), *vertices]),
        triangle_indices=np.concatenate([np.empty((0, 3), np.int64), *triangles]),
        vertex_colors=np.concatenate([np.empty(0, np.uint32), *shades]),
    )
    boundaries = rr.LineStrips3D(
        strips,
        colors=np.array(colors, np.uint32),  # of a list of three Rerun would make one
        radii=rr.Radius.ui_points(1.5),
        labels=list(labels) if any(labels) else None,
    )
    return boundaries, surface
