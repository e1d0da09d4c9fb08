"""Regions whose vertex goes: they stay where they are, fixed to the nearest vertex that stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapstream.operators.maps.regions import outline_corners, outlines
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray
from mapstream.streams.geometry import invert


def regions_rehomed(map_: Map, keep: BoolArray) -> Map:
    """Return the map with regions fixed to vertices where the mask is true, of their missions where these stay."""
    regions, vertices = map_.regions, map_.vertices
    if not len(regions) or not keep.any():
        return map_
    vertex, outline = regions.vertex.copy(), regions.outline.copy()
    T_map_base = map_.T_map_base(np.arange(len(vertices)))
    for row in np.flatnonzero(~keep[regions.vertex]).tolist():
        old = int(regions.vertex[row])
        own = keep & (vertices.mission == vertices.mission[old])
        stays = np.flatnonzero(own if own.any() else keep)
        away = np.linalg.norm(T_map_base[stays, :3, 3] - T_map_base[old, :3, 3], axis=1)
        new = int(stays[away.argmin()])
        T_new_old = invert(T_map_base[new]) @ T_map_base[old]
        corners = outline_corners(regions.outline[row]) @ T_new_old[:3, :3].T + T_new_old[:3, 3]
        vertex[row], outline[row] = new, outlines([corners])[0]
    return replace(map_, regions=replace(regions, vertex=vertex, outline=outline))
