"""Landmarks of a stored map: points, planes within their boundaries, objects with name, extent and axes."""

from __future__ import annotations

import numpy as np
import rerun as rr

from mapstream.graph.views.colors import AXES, ramp_colors
from mapstream.graph.views.growing import MAP_PATH
from mapstream.graph.views.objects import class_colors, extents
from mapstream.graph.views.planes import PLANE, drawn
from mapstream.graph.views.scene import Entry
from mapstream.operators.maps.where import extent_of
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.hulls import hull_of
from mapstream.recordings.maps.object_payload import object_payload
from mapstream.streams.arrays import FloatArray, IntArray

_AXIS_M = 0.3
_SIDE_M = 1.0  # of a plane without a boundary
_SQUARE = _SIDE_M / 2 * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])


def landmark_entries(map_: Map) -> list[Entry]:
    """Return the landmarks, a path per kind."""
    drawing = []
    for kind in dict.fromkeys(map_.landmarks.kind):
        rows = np.flatnonzero(map_.landmarks.kind == kind)
        path = f"{MAP_PATH}/landmarks/{rr.escape_entity_path_part(kind)}"
        drawing += _planes(map_, rows, path) if kind == "plane" else _marks(map_, rows, path)
    return drawing


def axes(T_map_frame: FloatArray, length_m: float) -> rr.Arrows3D:
    """Return the axes of frames (N, 4, 4): x red, y green, z blue."""
    vectors = length_m * np.swapaxes(T_map_frame[:, :3, :3], 1, 2).reshape(-1, 3)
    origins = np.repeat(T_map_frame[:, :3, 3], 3, axis=0)
    return rr.Arrows3D(vectors=vectors, origins=origins, colors=np.tile(AXES, len(T_map_frame)))


def _marks(map_: Map, rows: IntArray, path: str) -> list[Entry]:
    """Return points coloured by height, with their labels and, where they are turned, their axes."""
    poses = map_.T_map_landmark(rows)
    low, high = np.percentile(poses[:, 2, 3], [2, 98])
    colors = ramp_colors(poses[:, 2, 3], float(low), float(high))
    captions = _captions(map_, rows)
    if any(captions):
        classes = map_.landmarks.label[rows]
        colors = np.where(classes == "", colors, class_colors(classes.tolist()))
    marks = rr.Points3D(
        poses[:, :3, 3],
        colors=colors,
        radii=rr.Radius.ui_points(4 if any(captions) else 2),
        labels=captions if any(captions) else None,
    )
    is_turned = np.isfinite(map_.landmarks.quat_base_xyzw[rows]).all(axis=1)
    turned = [Entry.of(f"{path}/axes", axes(poses[is_turned], _AXIS_M))] if is_turned.any() else []
    return [Entry.of(path, marks), *turned, *_sized(map_, rows, path)]


def _sized(map_: Map, rows: IntArray, path: str) -> list[Entry]:
    """Return the boxes of landmarks whose extents are known."""
    known = [(row, size) for row in rows.tolist() if (size := extent_of(map_, row)) is not None]
    if not known:
        return []
    sized = np.array([row for row, _ in known])
    colors = class_colors(map_.landmarks.label[sized].tolist())
    boxes = extents(map_.T_map_landmark(sized), np.array([size for _, size in known]), colors)
    return [Entry.of(f"{path}/extents", boxes)]


def _captions(map_: Map, rows: IntArray) -> list[str]:
    """Return what stands beside landmarks: the name that people gave, else text and class."""
    captions = []
    for row in rows.tolist():
        known, label = object_payload(map_.landmarks, row), map_.landmarks.label[row]
        captions.append(
            str(known.get("name") or " ".join(filter(None, (label, known.get("text")))))
        )
    return captions


def _planes(map_: Map, rows: IntArray, path: str) -> list[Entry]:
    """Return the outlines of planes, a square where one has none, and their surfaces."""
    hulls = [hull_of(map_.landmarks.payload[row]) for row in rows]
    hulls = [hull if len(hull) >= 2 else _SQUARE for hull in hulls]
    names = _captions(map_, rows)
    boundaries, surface = drawn(map_.T_map_landmark(rows), hulls, [PLANE] * len(rows), names)
    return [Entry.of(path, boundaries), Entry.of(f"{path}/surface", surface)]
