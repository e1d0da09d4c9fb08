"""What speaks for a pose among known planes: what is seen lies on them, and none of them hides it.

Both are asked of some points within each outline, of many poses at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mapstream.operators.planes.seen_plane import SeenPlane
from mapstream.streams.arrays import BoolArray, FloatArray

_CORNERS = 8  # of an outline that are sampled
_INWARD = (0.35, 0.75)  # shares of the way from the middle to a corner
_MOST_AREA_M2 = 1.0  # a plane counts by its area, up to this: large ones are everywhere
_INSIDE_M = 0.1  # so far within its outline a plane hides what lies behind it
_BESIDE_M = 0.1  # so far out of its outline a plane may have more


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Points of planes that are seen, and from where."""

    points: FloatArray  # (N, S, 3)
    normals: FloatArray  # (N, 3)
    origins: FloatArray  # (N, 3) of the sight
    weights: FloatArray  # (N,) sum 1


def samples_of(seen: Sequence[SeenPlane], origins: FloatArray) -> Samples:
    """Return points of planes that were seen from origins (N, 3)."""
    points, areas = [], []
    for plane in seen:
        middle = plane.hull_m.mean(axis=0)
        picked = np.linspace(0, len(plane.hull_m), _CORNERS, endpoint=False).astype(np.int64)
        out = plane.hull_m[picked] - middle
        places = np.concatenate([middle + share * out for share in _INWARD])
        points.append(places @ plane.T_frame_plane[:3, :2].T + plane.origin)
        areas.append(min(cv2.contourArea(plane.hull_m.astype(np.float32)), _MOST_AREA_M2))
    normals = np.array([plane.normal for plane in seen]).reshape(-1, 3)
    weights = np.array(areas)
    return Samples(np.array(points), normals, origins, weights / max(weights.sum(), 1e-9))


class KnownOutlines:
    """Planes of a map, asked for points on them and behind them."""

    def __init__(self, known: Sequence[SeenPlane]) -> None:
        self._rotations = np.array([plane.T_frame_plane[:3, :3] for plane in known])
        self._origins = np.array([plane.origin for plane in known])
        self._sides = [_sides(plane.hull_m) for plane in known]

    def scores(
        self, samples: Samples, poses: FloatArray, *, angle_rad: float, distance_m: float
    ) -> FloatArray:
        """Return for poses (T, 4, 4) the share of what is seen that lies on known planes, less what they hide.

        Args:
            samples: Of what is seen.
            poses: Of the frame of the samples, in that of the known planes.
            angle_rad: Between a plane and a known one, at most.
            distance_m: Of a point from a known plane, at most.
        """
        R, t = poses[:, :3, :3], poses[:, :3, 3]
        points = np.einsum("tij,nsj->tnsi", R, samples.points) + t[:, None, None]
        origins = np.einsum("tij,nj->tni", R, samples.origins) + t[:, None]
        normals = np.einsum("tij,nj->tni", R, samples.normals)
        is_on = np.zeros(points.shape[:3], dtype=np.bool_)
        is_hidden = np.zeros(points.shape[:3], dtype=np.bool_)
        for rotation, origin, sides in zip(
            self._rotations, self._origins, self._sides, strict=True
        ):
            inside = (points - origin) @ rotation
            start = ((origins - origin) @ rotation)[:, :, None]
            is_alike = (normals @ rotation[:, 2] > np.cos(angle_rad))[:, :, None]
            is_on |= (
                is_alike
                & (np.abs(inside[..., 2]) < distance_m)
                & _within(inside[..., :2], sides, -_BESIDE_M)
            )
            crosses = (start[..., 2] > distance_m) & (inside[..., 2] < -distance_m)
            crosses |= (start[..., 2] < -distance_m) & (inside[..., 2] > distance_m)
            if crosses.any():
                way = start[..., 2] - inside[..., 2]
                share = start[..., 2] / np.where(crosses, way, 1.0)
                at = start[..., :2] + share[..., None] * (inside[..., :2] - start[..., :2])
                is_hidden |= crosses & _within(at, sides, _INSIDE_M)
        value = is_on.mean(axis=2) - is_hidden.mean(axis=2)
        scores: FloatArray = value @ samples.weights
        return scores


def _sides(hull_m: FloatArray) -> FloatArray:
    """Return lines (K, 3) with `line @ [x, y, 1]` the distance inwards from a side of a hull."""
    along = np.roll(hull_m, -1, axis=0) - hull_m
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1)
    inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-9)
    return np.column_stack([inward, -(inward * hull_m).sum(axis=1)])


def _within(places: FloatArray, sides: FloatArray, inside_m: float) -> BoolArray:
    is_within = np.ones(places.shape[:-1], dtype=np.bool_)
    for x, y, offset in sides.tolist():
        is_within &= x * places[..., 0] + y * places[..., 1] + offset > inside_m
    return is_within
