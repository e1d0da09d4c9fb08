"""The map on the screen: what corrections, loops and maps draw together, newest last.

They draw the same entities, so that a live map turns into the final one without a second copy of it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import rerun as rr

from mapstream.graph.views.colors import mission_color, switch_colors
from mapstream.graph.views.scene import Entry, Scene, Vertex, transform
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.geometry import SE3

MAP_PATH = "/map"
LINE = rr.Radius.ui_points(3.5)
_MOVED = 0.005  # [m], and about [rad]: a submap that moved less is left where it is


def redraw_mission(
    scene: Scene, mission_id: str, stamps_ns: IntArray, T_map_base: FloatArray
) -> list[Entry]:
    """Draw a mission's trajectory, and move its submaps to where they belong now.

    Args:
        scene: Remembers the trajectory for loops that come later.
        mission_id: 32 hex digits.
        stamps_ns: (N,), increasing.
        T_map_base: (N, 4, 4), the corrected poses.
    """
    if not len(stamps_ns):
        return []
    positions = T_map_base[:, :3, 3]
    scene.corrected[mission_id] = stamps_ns, positions
    scene.driven = {ns: p for ns, p in scene.driven.items() if ns > stamps_ns[-1]}
    color = mission_color(scene.mission_number(mission_id))
    line = rr.LineStrips3D(positions[None].astype(np.float32), colors=color, radii=LINE)
    drawing = [Entry.of(f"{MAP_PATH}/trajectory/{mission_id[:8]}", line)]
    rows = {(mission_id, int(stamp_ns)): row for row, stamp_ns in enumerate(stamps_ns)}
    for path, (vertex, T_before) in scene.submaps.items():
        row = rows.get(vertex)
        if row is None:
            continue
        if np.abs(T_before.matrix - T_map_base[row]).max() > _MOVED:
            T_now = SE3(T_map_base[row])
            scene.submaps[path] = vertex, T_now
            drawing.append(Entry.of(path, transform(T_now)))
    return drawing


def redraw_loops(scene: Scene) -> list[Entry]:
    """Draw every loop where its ends are now, coloured by its switch."""
    if not scene.loops:
        return []
    starts = _positions(scene, [a for a, _ in scene.loops])
    ends = _positions(scene, [b for _, b in scene.loops])
    lines = np.stack([starts, ends], axis=1).astype(np.float32)
    is_known = np.isfinite(lines).all(axis=(1, 2))
    colors = switch_colors(np.fromiter(scene.loops.values(), np.float64, len(scene.loops)))
    strips = rr.LineStrips3D(lines[is_known], colors=colors[is_known], radii=LINE)
    return [Entry.of(f"{MAP_PATH}/edges/loop", strips)]


def _positions(scene: Scene, vertices: list[Vertex]) -> FloatArray:
    """Return positions (N, 3) of vertices in the map; nan where they are not known."""
    missions = np.array([mission for mission, _ in vertices])
    stamps_ns = np.array([stamp_ns for _, stamp_ns in vertices], dtype=np.int64)
    positions: npt.NDArray[np.float64] = np.full((len(vertices), 3), np.nan)
    for mission_id in dict.fromkeys(missions):
        rows = np.flatnonzero(missions == mission_id)
        found = scene.places(stamps_ns[rows], str(mission_id))
        if found is not None:
            positions[rows] = found
    return positions
