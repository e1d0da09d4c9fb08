"""Objects in a LiDAR's cloud: the dominant near cluster of the points that a camera sees in a box, off the ground."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mapstream.operators.objects.masks.clusters import dominant, pieces_of_points
from mapstream.operators.objects.masks.segment import Segment, network_mask
from mapstream.operators.objects.masks.surround import on_surround
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.objects import ObjectDetections

_LEAST_DEPTH_M = 0.3
_AROUND = 0.5  # of the box on each side, for what is around it
_MIN_POINTS = 4
_MIN_LEFT = 0.1  # of the points in the box, off the ground
_GROUND_M = 0.12  # so far above it points are of the ground
_REACH_M = 0.35  # between points of one thing
_REACH_SHARE = 0.012  # the same, of their depth: beams part
_MAX_RADIUS_PX = 12


@dataclass(frozen=True, slots=True, eq=False)
class SeenPoints:
    """Points of a cloud that a camera sees."""

    points: FloatArray  # (N, 3) in the camera frame [m]
    px: FloatArray  # (N, 2)
    up: FloatArray  # (3,) z of the base, in the camera frame


def seen_points(points: FloatArray, T_camera_base: SE3, camera: CameraCalibration) -> SeenPoints:
    """Return points (N, 3) of the base frame as a camera sees them; those out of its image are left out."""
    moved = points @ T_camera_base.R.T + T_camera_base.t
    moved = moved[moved[:, 2] > _LEAST_DEPTH_M]
    px, is_seen = project(camera, moved)
    last = np.array([camera.width_px, camera.height_px]) - 0.5
    is_seen &= ((px >= -0.5) & (px < last)).all(axis=1)
    return SeenPoints(moved[is_seen], px[is_seen], T_camera_base.R[:, 2])


def lidar_segment(detections: ObjectDetections, row: int, seen: SeenPoints) -> Segment | None:
    """Return what of a box is the object; None where too few points lie in it."""
    box = detections.boxes_px[row].astype(np.float64)
    sides = box[2:] - box[:2]
    inside = ((seen.px >= box[:2]) & (seen.px <= box[2:])).all(axis=1)
    chosen, given = inside.copy(), network_mask(detections, row)
    if given is not None:
        chosen[inside] = _inside(detections, row, given, seen.px[inside])
    if chosen.sum() < _MIN_POINTS:
        return None
    near = ((seen.px >= box[:2] - _AROUND * sides) & (seen.px <= box[2:] + _AROUND * sides)).all(axis=1)  # fmt: skip
    points, px = seen.points[chosen], seen.px[chosen]
    margin_m = np.full(len(points), _GROUND_M)
    is_on = on_surround(points, seen.points[near & ~inside], margin_m, seen.up)
    if (~is_on).mean() >= _MIN_LEFT and (~is_on).sum() >= _MIN_POINTS:
        points, px = points[~is_on], px[~is_on]
    pieces = pieces_of_points(points, _REACH_M + _REACH_SHARE * points[:, 2])
    off = np.abs(2 * (px - box[:2]) / sides - 1)
    size_m = float((sides / _focal_px(detections)).max())
    is_object = dominant(pieces, (1.1 - off).clip(min=0.1).prod(axis=1), points[:, 2], size_m)
    if is_object.sum() < _MIN_POINTS:
        return None
    if given is not None:
        return Segment(given, points[is_object], "model")
    return Segment(_spots(detections, row, px[is_object]), points[is_object], "lidar")


def _inside(detections: ObjectDetections, row: int, mask: BoolArray, px: FloatArray) -> BoolArray:
    """Return which points (N, 2) that lie in a box lie in its mask."""
    rows, columns = detections.window(row)
    at = np.round(px).astype(np.int64) - [columns.start, rows.start]
    at = np.clip(at, 0, [mask.shape[1] - 1, mask.shape[0] - 1])
    inside: BoolArray = mask[at[:, 1], at[:, 0]]
    return inside


def _focal_px(detections: ObjectDetections) -> float:
    camera = detections.camera
    return float(detections.width_px if camera is None else camera.focal_px.mean())


def _spots(detections: ObjectDetections, row: int, px: FloatArray) -> BoolArray:
    """Return the pixels (h, w) of a box around points (N, 2), as far as the next beams."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # takes long to import

    rows, columns = detections.window(row)
    mask = np.zeros((rows.stop - rows.start, columns.stop - columns.start), np.uint8)
    fourth = min(4, len(px) - 1)  # two are beside it on its own beam, two on the next ones
    apart_px = cKDTree(px).query(px, fourth + 1)[0][:, fourth]
    radius = int(np.clip(np.ceil(np.median(apart_px) / 2), 1, _MAX_RADIUS_PX))
    for x, y in np.round(px - [columns.start, rows.start]).astype(int).tolist():
        cv2.circle(mask, (x, y), radius, 1, cv2.FILLED)
    return mask.astype(np.bool_)
