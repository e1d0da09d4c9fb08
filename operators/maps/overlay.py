"""The map over a picture: where its landmarks, planes and objects are in an image taken at a known pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.recordings.maps.cameras import Camera
from mapstream.recordings.maps.hulls import hull_of
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.camera_models import project
from mapstream.streams.geometry import SE3

_STEP_M = 0.1  # between points of an outline: lines are curves where a lens bends them


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlay:
    """What of a map an image shows, hidden or not: a map of points hides nothing."""

    landmarks: IntArray  # (N,) rows of points inside the image
    points_px: FloatArray  # (N, 2)
    outlines_px: tuple[FloatArray, ...]  # each (K, 2): parts of boundaries of planes
    outline_labels: tuple[str, ...]


def overlay(map_: Map, camera: Camera, T_map_base: SE3) -> Overlay:
    """Return the map as a camera sees it.

    Args:
        map_: The map.
        camera: Its calibration and place on the robot.
        T_map_base: Where the robot was when it took the image.
    """
    T_camera_map = (T_map_base @ camera.T_base_sensor).inverse()
    is_plane = map_.landmarks.kind == "plane"
    rows = np.flatnonzero(~is_plane)
    points = map_.T_map_landmark(rows)[:, :3, 3]
    px, inside = _inside(camera, T_camera_map @ points)
    outlines, labels = [], []
    planes = np.flatnonzero(is_plane)
    for row, T_map_plane in zip(planes.tolist(), map_.T_map_landmark(planes), strict=True):
        line = _outline(map_.landmarks.payload[row])
        line_px, shown = _inside(camera, T_camera_map @ (SE3(T_map_plane) @ line))
        parts = [part for part in _runs(line_px, shown) if len(part) > 1]
        outlines += parts
        labels += [str(map_.landmarks.label[row])] * len(parts)
    return Overlay(
        landmarks=rows[inside],
        points_px=px[inside],
        outlines_px=tuple(outlines),
        outline_labels=tuple(labels),
    )


def _inside(camera: Camera, p_camera: FloatArray) -> tuple[FloatArray, BoolArray]:
    px, is_valid = project(camera.calibration, p_camera)
    size = (camera.calibration.width_px, camera.calibration.height_px)
    with np.errstate(invalid="ignore"):
        return px, is_valid & ((px >= -0.5) & (px <= np.array(size) - 0.5)).all(axis=1)


def _outline(payload: bytes) -> FloatArray:
    """Return points (N, 3) along the closed boundary of a plane, in its frame; none where it has no hull."""
    hull = hull_of(payload)
    if len(hull) < 2:
        return np.empty((0, 3))
    corners = np.column_stack([hull, np.zeros(len(hull))])
    sides = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    return np.concatenate(
        [
            np.linspace(a, b, max(2, int(np.linalg.norm(b - a) / _STEP_M) + 1), endpoint=False)
            for a, b in sides
        ]
        + [corners[:1]]
    )


def _runs(px: FloatArray, shown: BoolArray) -> list[FloatArray]:
    """Return the stretches of a line that are shown."""
    borders = np.flatnonzero(np.diff(shown.astype(np.int8), prepend=0, append=0))
    return [px[start:stop] for start, stop in borders.reshape(-1, 2)]
