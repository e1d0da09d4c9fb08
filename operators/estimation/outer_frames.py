"""Where outer frames lie before they were ever estimated: where their measurements agree with the poses.

Source: Umeyama, Least-squares estimation of transformation parameters, PAMI 1991, without the scale.
"""

from __future__ import annotations

import numpy as np

from mapstream.operators.estimation.factors.mounts import MountOf
from mapstream.operators.estimation.factors.payloads import payloads
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray


def starting_frames(map_: Map, rows: IntArray) -> FloatArray:
    """Return T_map_frame (N, 4, 4) of outer frames; those that lie somewhere already stay there."""
    frames = map_.frames.T_map_frame[rows].copy()
    for at, row in enumerate(rows.tolist()):
        if not map_.frames.is_known[row] and np.array_equal(frames[at], np.eye(4)):
            frames[at] = _aligned(map_, row)
    return frames


def _aligned(map_: Map, frame: int) -> FloatArray:
    """Return T_map_frame (4, 4) from positions, and from one orientation where one was measured."""
    edges = map_.edges
    is_in = (edges.frame == frame) & (edges.vertex_a >= 0)
    chosen = np.flatnonzero(is_in & np.isin(edges.kind, ("absolute", "position")))
    if not len(chosen):
        return np.eye(4)
    mount_of, given = MountOf(map_), payloads(map_, chosen)
    vertices = edges.vertex_a[chosen]
    T_base_sensor = np.array(
        [mount_of(int(v), given[row])[0] for v, row in zip(vertices, chosen.tolist(), strict=True)]
    )
    T_map_sensor = map_.T_map_base(vertices) @ T_base_sensor
    oriented = np.flatnonzero(edges.kind[chosen] == "absolute")
    if len(oriented):
        first = oriented[0]
        R = T_map_sensor[first, :3, :3] @ edges.T_a_b[chosen[first], :3, :3].T
        return _placed(R, T_map_sensor[:, :3, 3], edges.T_a_b[chosen, :3, 3])
    p_map, p_frame = T_map_sensor[:, :3, 3], edges.T_a_b[chosen, :3, 3]
    return _placed(_rotation(p_map, p_frame), p_map, p_frame)


def _placed(R: FloatArray, p_map: FloatArray, p_frame: FloatArray) -> FloatArray:
    """Return the transform (4, 4) with a rotation that brings the means of points (N, 3) together."""
    T_map_frame = np.eye(4)
    T_map_frame[:3, :3] = R
    T_map_frame[:3, 3] = p_map.mean(axis=0) - R @ p_frame.mean(axis=0)
    return T_map_frame


def _rotation(p_map: FloatArray, p_frame: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) from the frame to the map that fits points (N, 3) best.

    On a straight line the turn about it is open; then z of both is taken to be up.
    """
    centred_map, centred_frame = p_map - p_map.mean(axis=0), p_frame - p_frame.mean(axis=0)
    U, spread, Vt = np.linalg.svd(centred_map.T @ centred_frame)
    if spread[1] > 1e-3 * spread[0] > 0:
        sign = np.diag([1.0, 1.0, np.linalg.det(U @ Vt)])
        return np.asarray(U @ sign @ Vt, dtype=np.float64)
    planar = centred_map[:, :2].T @ centred_frame[:, :2]
    angle = np.arctan2(planar[1, 0] - planar[0, 1], planar[0, 0] + planar[1, 1])
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
