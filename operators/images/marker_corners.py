"""Corners of markers to a tenth of a pixel: where lines through their black borders meet.

Each side has some dozens of pixels to say where it is, a corner has a few. On rendered images of tags 20 to 40 px wide
lines leave 0.07 px, the saddle that OpenCV looks for 0.44 px. Sides are straight for a pinhole camera only, so lines
are those of one that looks the same way.
Source: Wang and Olson, AprilTag 2: Efficient and robust fiducial detection, IROS 2016, section III-B.
"""

from __future__ import annotations

import cv2
import numpy as np

from mapstream.operators.features.gray import GrayImage
from mapstream.operators.images.pinhole_maps import pinhole_like
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project, unproject

_CELLS = 8  # along a side of the usual families; others have 6 to 10
_STEP_PX = 0.25  # across a side
_REACH_PX = 3.0  # to both of its sides
_ENDS = 0.08  # of a side that are left out: the other sides' edges are near
_ROUNDS = 3  # of leaving out what is far from the line
_LEAST_WEIGHT = 0.3  # of the usual contrast
_LEAST_ERROR_PX = 0.1  # of a point that is left out


def refined_corners(
    image: GrayImage, camera: CameraCalibration, corners_px: FloatArray
) -> FloatArray:
    """Return the corners (4, 2) of a marker, found to a pixel before.

    They are returned as they were if a side has no contrast, or lines meet elsewhere.
    """
    straight = pinhole_like(camera)
    sides = [_edge(image, corners_px[i], corners_px[(i + 1) % 4]) for i in range(4)]
    lines = [_line(_moved(camera, straight, points), weights) for points, weights in sides]
    normals = np.array([normal for normal, _ in lines])
    distances = np.array([distance for _, distance in lines])
    pairs = np.stack([np.roll(normals, 1, axis=0), normals], axis=1)  # of the sides at each corner
    if not (np.isfinite(pairs).all() and (np.abs(np.linalg.det(pairs)) > 1e-3).all()):
        return corners_px
    ends = np.stack([np.roll(distances, 1), distances], axis=1)
    found = _moved(straight, camera, np.linalg.solve(pairs, ends[:, :, None])[:, :, 0])
    is_near = np.linalg.norm(found - corners_px, axis=1) <= _REACH_PX
    return found if is_near.all() else corners_px


def _moved(old: CameraCalibration, new: CameraCalibration, px: FloatArray) -> FloatArray:
    """Return where another camera in the same place sees pixels (N, 2)."""
    return project(new, unproject(old, px))[0]


def _edge(image: GrayImage, start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where the image changes most (N, 2), about a line between two points, and how much (N,)."""
    length_px = float(np.linalg.norm(end - start))
    along = (end - start) / length_px
    across = np.array([along[1], -along[0]])
    reach_px = _REACH_PX * np.clip(length_px / _CELLS / _REACH_PX, 0.5, 1.0)
    places = np.linspace(_ENDS * length_px, (1 - _ENDS) * length_px, max(int(length_px), 8))
    offsets = np.arange(-reach_px, reach_px + _STEP_PX / 2, _STEP_PX)
    samples = (
        start + places[:, None, None] * along + offsets[None, :, None] * across
    )  # (along, across, 2)
    x, y = np.moveaxis(samples.astype(np.float32), 2, 0)
    values = cv2.remap(image, x, y, cv2.INTER_LINEAR).astype(np.float64)
    changes = np.diff(values, axis=1)
    contrast = np.maximum(changes * np.sign(changes.sum()), 0.0)  # all sides go from black to white
    weights = contrast.sum(axis=1)
    middles = (offsets[1:] + offsets[:-1]) / 2
    found = (contrast @ middles) / np.maximum(weights, 1e-6)
    return start + places[:, None] * along + found[:, None] * across, weights


def _line(points: FloatArray, weights: FloatArray) -> tuple[FloatArray, float]:
    """Return the line (normal, distance) of points (N, 2), without those that are far from it or say little."""
    is_clear = (weights > _LEAST_WEIGHT * np.median(weights)) & np.isfinite(points).all(axis=1)
    is_used = is_clear
    normal, distance = np.full(2, np.nan), np.nan
    for _ in range(_ROUNDS):
        if is_used.sum() < 3:
            return np.full(2, np.nan), np.nan
        middle = np.average(points[is_used], axis=0, weights=weights[is_used])
        spread = (points[is_used] - middle) * np.sqrt(weights[is_used, None])
        direction = np.linalg.svd(spread, full_matrices=False)[2][0]
        normal = np.array([-direction[1], direction[0]])
        distance = float(normal @ middle)
        errors_px = np.abs(np.nan_to_num(points) @ normal - distance)
        limit_px = max(2 * float(np.median(errors_px[is_used])), _LEAST_ERROR_PX)
        is_used = is_clear & (errors_px < limit_px)
    return normal, distance
