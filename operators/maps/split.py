"""One mission made two."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapstream.recordings.maps.edge_kinds import MOTION_KINDS
from mapstream.recordings.maps.ids import derived_id, id_array
from mapstream.recordings.maps.model import Map, vertex_ids
from mapstream.recordings.maps.rows import concatenate, take


def split_mission(map_: Map, mission_row: int, stamp_ns: int) -> tuple[Map, str]:
    """Return the map with a mission of its own for the vertices from a stamp on, and the id of that one.

    It lies where it lay, and is as well known. Measured motions and IMU samples across the cut go; loops stay.
    """
    vertices, edges = map_.vertices, map_.edges
    is_later = (vertices.mission == mission_row) & (vertices.stamp_ns >= stamp_ns)
    new_id = derived_id("split", map_.missions.id[mission_row].tobytes(), stamp_ns)
    later = take(map_.missions, np.array([mission_row]))
    later = replace(later, id=id_array([new_id]))
    ids, mission = vertices.id.copy(), vertices.mission.copy()
    ids[is_later] = vertex_ids(new_id.hex(), vertices.stamp_ns[is_later])
    mission[is_later] = len(map_.missions)
    side = np.append(is_later, False)
    has_ends = (edges.vertex_a >= 0) & (edges.vertex_b >= 0)
    is_cut = has_ends & (side[edges.vertex_a] != side[edges.vertex_b])
    is_cut &= np.isin(edges.kind, (*MOTION_KINDS, "imu"))
    cut = map_.select(edges=~is_cut)
    split = replace(
        cut,
        missions=concatenate([cut.missions, later]),
        vertices=replace(vertices, id=ids, mission=mission),
    )
    return split, new_id.hex()
