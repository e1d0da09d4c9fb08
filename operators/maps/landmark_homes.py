"""Landmarks whose vertex goes: those that others still see move to one of these; regions to the nearest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapstream.operators.maps.region_homes import regions_rehomed
from mapstream.recordings.maps.model import Map
from mapstream.recordings.maps.tables import Landmarks
from mapstream.streams.arrays import BoolArray, IntArray
from mapstream.streams.geometry import (
    invert,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
    symmetric,
)


def without_vertices(map_: Map, keep: BoolArray) -> Map:
    """Return the map with the vertices where the mask is true, less all that needs the others.

    A landmark that was fixed to a vertex that goes, and is seen from one that stays, is fixed to the first such.
    """
    return rehomed(map_, keep).select(vertices=keep)


def rehomed(map_: Map, keep: BoolArray) -> Map:
    """Return the map with landmarks fixed to vertices where the mask is true, wherever one sees them; regions, too."""
    map_ = regions_rehomed(map_, keep)
    landmarks, vertices = map_.landmarks, map_.vertices
    lost = np.flatnonzero(~keep[landmarks.vertex])
    home = _first_observers(map_, keep)[lost]
    lost, home = lost[home >= 0], home[home >= 0]
    if not len(lost):
        return map_
    T_map_base = map_.T_map_base(np.arange(len(vertices)))
    T_new_old = invert(T_map_base[home]) @ T_map_base[landmarks.vertex[lost]]
    R = T_new_old[:, :3, :3]
    vertex, p_base = landmarks.vertex.copy(), landmarks.p_base.copy()
    quat, covariance = landmarks.quat_base_xyzw.copy(), landmarks.covariance.copy()
    vertex[lost] = home
    p_base[lost] = (R @ p_base[lost, :, None])[..., 0] + T_new_old[:, :3, 3]
    is_turned = np.isfinite(quat[lost]).all(axis=1)
    turned = R[is_turned] @ rotation_from_quat_xyzw(quat[lost[is_turned]])
    quat[lost[is_turned]] = quat_xyzw_from_rotation(turned)
    covariance[lost] = R @ covariance[lost] @ np.swapaxes(R, 1, 2)
    moved: Landmarks = replace(
        landmarks,
        vertex=vertex,
        p_base=p_base,
        quat_base_xyzw=quat,
        covariance=symmetric(covariance),
    )
    return replace(map_, landmarks=moved)


def _first_observers(map_: Map, keep: BoolArray) -> IntArray:
    """Return for each landmark the first vertex (by row) of those that stay and see it; -1 without one."""
    seen, edges = map_.observations, map_.edges
    landmark = np.concatenate([seen.landmark, edges.landmark_a])
    vertex = np.concatenate([seen.vertex, edges.vertex_a])
    stays = (landmark >= 0) & (vertex >= 0)
    stays[stays] &= keep[vertex[stays]]
    first = np.full(len(map_.landmarks), len(keep))
    np.minimum.at(first, landmark[stays], vertex[stays])
    return np.where(first < len(keep), first, -1)
