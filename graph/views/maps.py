"""A map as it is stored: missions, loops by their switch, other edges, landmarks, outer frames."""

from __future__ import annotations

import numpy as np
import rerun as rr

from mapstream.graph.views.ceiling import is_below_ceiling
from mapstream.graph.views.colors import photographed, switch_colors
from mapstream.graph.views.constraints import place_frames
from mapstream.graph.views.drive import drive_entries
from mapstream.graph.views.growing import LINE, MAP_PATH, redraw_loops, redraw_mission
from mapstream.graph.views.landmarks import landmark_entries
from mapstream.graph.views.lidar import height_colors
from mapstream.graph.views.observers import observer_entries
from mapstream.graph.views.outer_frames import outer_frame_entries
from mapstream.graph.views.regions import region_entries
from mapstream.graph.views.scene import Columns, Drawing, Entry, Scene, Vertex
from mapstream.recordings.maps import Map
from mapstream.streams.messages.estimates import PointCloud

_CLOUD_SIZE = rr.Radius.ui_points(1.2)
_QUIET = ("odometry", "imu", "loop")  # along the trajectory, or drawn with the live loops


def view_map(map_: Map, scene: Scene) -> Drawing:
    """Draw all that a map holds.

    That is each mission's trajectory, robot and states, loops by switch value, other edges and landmarks by kind,
    from where landmarks were seen, regions, and outer frames.
    """
    drawing: list[Entry | Columns] = []
    for row in range(len(map_.missions)):
        vertices = map_.vertices_of(row)
        stamps_ns, poses = map_.vertices.stamp_ns[vertices], map_.T_map_base(vertices)
        drawing += redraw_mission(scene, map_.mission_id(row), stamps_ns, poses)
    edges = map_.edges
    for edge in map_.edges_of("loop"):
        ends = _vertex(map_, edges.vertex_a[edge]), _vertex(map_, edges.vertex_b[edge])
        scene.loops[ends] = float(edges.switch[edge])
    drawing += [*redraw_loops(scene), *place_frames(map_)]
    drawing += [*_edges(map_), *landmark_entries(map_), *observer_entries(map_)]
    drawing += region_entries(map_)
    return [*drawing, *outer_frame_entries(map_), *drive_entries(map_)]


def cloud_entry(map_: Map, cloud: PointCloud, scene: Scene) -> Entry:
    """Draw the cloud of a whole map, in its frame, without a ceiling, as cameras saw it, else coloured by height."""
    path = map_.T_map_base(np.arange(len(map_.vertices)))[:, :3, 3]
    shown = is_below_ceiling(cloud.points, path)
    points = cloud.points[shown]
    colors = height_colors(points[:, 2], scene)
    if cloud.colors_rgba is not None:
        colors = photographed(colors, cloud.colors_rgba[shown])
    return Entry.of(f"{MAP_PATH}/cloud", rr.Points3D(points, colors=colors, radii=_CLOUD_SIZE))


def _vertex(map_: Map, row: np.int64) -> Vertex:
    vertices = map_.vertices
    return map_.mission_id(int(vertices.mission[row])), int(vertices.stamp_ns[row])


def _edges(map_: Map) -> list[Entry]:
    """Return the edges between vertices that have not been drawn yet, a path per kind."""
    drawing = []
    edges = map_.edges
    for kind in dict.fromkeys(edges.kind):
        rows = np.flatnonzero((edges.kind == kind) & (edges.vertex_b >= 0))
        if kind in _QUIET or not len(rows):
            continue
        ends = [map_.T_map_base(v[rows])[:, :3, 3] for v in (edges.vertex_a, edges.vertex_b)]
        lines = np.stack(ends, axis=1).astype(np.float32)
        strips = rr.LineStrips3D(lines, colors=switch_colors(edges.switch[rows]), radii=LINE)
        drawing.append(Entry.of(f"{MAP_PATH}/edges/{kind}", strips))
    return drawing
