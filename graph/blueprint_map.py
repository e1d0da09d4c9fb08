"""The layout of the viewer for a stored map: the map, what the cameras saw, and the states."""

from __future__ import annotations

import numpy as np
import rerun.blueprint as rrb

from mapstream.graph.blueprint import CLOSED, map_view
from mapstream.graph.views.drive import STATES, picture_path
from mapstream.graph.views.growing import MAP_PATH
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.cameras import cameras_of
from mapstream.streams.arrays import FloatArray

_MAX_CAMERAS = 4  # more are too small to see anything in
_HIDDEN = (f"{MAP_PATH}/observers",)  # rays hide the rest


def map_blueprint(map_: Map) -> rrb.Blueprint:
    """Return the layout of a stored map, seen from a height that shows all of it."""
    missions = range(len(map_.missions))
    cameras = [(mission, name) for mission in missions for name in cameras_of(map_, mission)]
    views: list[rrb.View] = [
        rrb.Spatial2DView(name=name, origin=picture_path(map_, mission, name, ""))
        for mission, name in cameras[:_MAX_CAMERAS]
    ]
    if np.isfinite(map_.vertices.velocity_mps).all(axis=1).any():
        views.append(rrb.TimeSeriesView(name="States", origin=STATES))
    view = map_view(eye=_eye(_shown(map_)), hidden_paths=_HIDDEN)
    main = rrb.Horizontal(view, rrb.Vertical(*views), column_shares=[5, 2]) if views else view
    time = rrb.TimePanel(timeline="stamp", state="collapsed")
    return rrb.Blueprint(main, time, *CLOSED)


def _shown(map_: Map) -> FloatArray:
    """Return points (N, 3) that must be seen: the way, and landmarks but for a few far ones."""
    path = map_.T_map_base(np.arange(len(map_.vertices)))[:, :3, 3]
    points = map_.T_map_landmark(np.arange(len(map_.landmarks)))[:, :3, 3]
    if len(points):
        low, high = np.percentile(points, [2, 98], axis=0)
        points = points[((points >= low) & (points <= high)).all(axis=1)]
    return np.concatenate([path, points])


def _eye(points: FloatArray) -> rrb.EyeControls3D:
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else np.zeros((2, 3))
    middle, size_m = (low + high) / 2, float(np.linalg.norm(high - low)) + 5.0
    return rrb.EyeControls3D(
        position=middle + size_m * np.array([0.0, -0.45, 0.65]),
        look_target=middle,
        eye_up=(0.0, 0.0, 1.0),
    )
