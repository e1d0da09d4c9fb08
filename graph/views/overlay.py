"""The map over the pictures of a mission: landmarks where the map says they are, and where they were seen."""

from __future__ import annotations

import numpy as np
import rerun as rr

from mapstream.graph.views.colors import KEYPOINT, ramp_colors
from mapstream.graph.views.scene import Entry
from mapstream.operators.maps.overlay import overlay
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.cameras import Camera
from mapstream.streams.geometry import SE3

_POINT = rr.Radius.ui_points(2.0)
_LINE = rr.Radius.ui_points(1.0)
_OUTLINE = 0x56B4E9FF


def overlay_entries(map_: Map, camera: Camera, name: str, vertex: int) -> list[Entry]:
    """Return what belongs over the picture of one camera at one vertex.

    Landmarks that the camera saw are joined to their keypoints by a line: its length is the residual.
    """
    T_map_base = SE3(map_.T_map_base(np.array([vertex]))[0])
    shown = overlay(map_, camera, T_map_base)
    seen = map_.observations
    rows = np.flatnonzero((seen.vertex == vertex) & (seen.sensor == name) & (seen.landmark >= 0))
    px_of = dict(zip(shown.landmarks.tolist(), shown.points_px, strict=True))
    rows = rows[[int(landmark) in px_of for landmark in seen.landmark[rows]]]
    at = np.isin(shown.landmarks, seen.landmark[rows])
    projected = np.array([px_of[int(landmark)] for landmark in seen.landmark[rows]])
    residuals = np.stack([seen.keypoint_px[rows], projected.reshape(-1, 2)], axis=1)
    lengths = np.linalg.norm(residuals[:, 1] - residuals[:, 0], axis=1)
    labels = map_.landmarks.label[shown.landmarks[at]].tolist()
    points = rr.Points2D(
        shown.points_px[at],
        colors=KEYPOINT,
        radii=_POINT,
        labels=labels if any(labels) else None,
        draw_order=10.0,
    )
    lines = rr.LineStrips2D(
        residuals, colors=ramp_colors(lengths, 0.0, 3.0), radii=_LINE, draw_order=11.0
    )
    outlines = rr.LineStrips2D(
        list(shown.outlines_px),
        colors=_OUTLINE,
        radii=_LINE,
        labels=list(shown.outline_labels) if any(shown.outline_labels) else None,
        draw_order=9.0,
    )
    return [
        Entry.of("landmarks", points),
        Entry.of("residuals", lines),
        Entry.of("planes", outlines),
    ]
