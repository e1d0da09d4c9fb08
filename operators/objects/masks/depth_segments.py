"""Objects in a depth image: the dominant near piece of what lies in a box, without what goes on around it."""

from __future__ import annotations

import cv2
import numpy as np

from mapstream.operators.objects.masks.clusters import dominant, pieces_of_depth
from mapstream.operators.objects.masks.segment import Segment, network_mask
from mapstream.operators.objects.masks.surround import on_surround
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray
from mapstream.streams.messages.objects import ObjectDetections, window
from mapstream.streams.structured_light import depth_sigma_m

_MAX_CELLS = 96  # along the longer side of a box; larger ones are looked at in steps
_MAX_AROUND = 40  # the same, of what is around it
_AROUND = 0.25  # of the box on each side, for what is around it
_MIN_KNOWN = 0.05  # of the pixels of a box
_MIN_LEFT = (
    0.15  # of the known pixels; an object that is less than that lies flat on what is around
)
_MIN_LEFT_OF_MASK = 0.5  # the same, where a network says which pixels it is
_NOISE = 3.0  # standard deviations of depth
_LEAST_MARGIN_M = 0.008


def depth_segment(
    detections: ObjectDetections, row: int, depth_m: Float32Array, rays: Float32Array
) -> Segment | None:
    """Return what of a box is the object; None where depth does not tell.

    Args:
        detections: Of one image.
        row: Which of them.
        depth_m: Of the same pixels (H, W), NaN where it is unknown.
        rays: Points of depth 1 m of the pixels (H, W, 3).
    """
    area = detections.window(row)
    full_m = depth_m[area]
    given = network_mask(detections, row)
    step = -(-max(full_m.shape) // _MAX_CELLS)
    z, own_rays = full_m[::step, ::step], rays[area][::step, ::step]
    known = np.isfinite(z)
    if given is not None:
        known &= given[::step, ::step]
    if known.sum() < max(_MIN_KNOWN * z.size, 4):
        return None
    points = (own_rays * z[..., None]).astype(np.float64)
    least = _MIN_LEFT if given is None else _MIN_LEFT_OF_MASK
    off = _off_surround(detections, row, depth_m, rays, points, known)
    known = off if off.sum() >= least * known.sum() else known
    pieces = pieces_of_depth(np.where(known, z, np.float32(np.nan)))
    weights = np.ones(z.shape) if given is not None else _weights(z.shape)
    size_m = float(np.abs(own_rays[0, 0] - own_rays[-1, -1]).max())
    is_object = dominant(pieces.ravel(), weights.ravel(), np.nan_to_num(z.ravel()), size_m)
    is_object = is_object.reshape(z.shape)
    mask = _enlarged(is_object, full_m.shape)
    if given is None:
        return Segment(_closed(mask), points[is_object], "depth")
    mask = given & (mask | ~np.isfinite(full_m))  # where depth is unknown the network is believed
    return Segment(mask, points[is_object], "model")


def _off_surround(
    detections: ObjectDetections,
    row: int,
    depth_m: Float32Array,
    rays: Float32Array,
    points: FloatArray,
    known: BoolArray,
) -> BoolArray:
    """Return which of the known points (h, w) are not on the planes around the box."""
    box = detections.boxes_px[row]
    reach = _AROUND * np.tile(box[2:] - box[:2], 2) * [-1, -1, 1, 1]
    rows, columns = window(box + reach, detections.width_px, detections.height_px)
    step = -(-max(rows.stop - rows.start, columns.stop - columns.start) // _MAX_AROUND)
    y, x = np.meshgrid(np.r_[rows][::step], np.r_[columns][::step], indexing="ij")
    own_rows, own_columns = detections.window(row)
    inside = (own_rows.start <= y) & (y < own_rows.stop)
    inside &= (own_columns.start <= x) & (x < own_columns.stop)
    usable = ~inside & np.isfinite(depth_m[y, x])
    y, x = y[usable], x[usable]
    around = (rays[y, x] * depth_m[y, x, None]).astype(np.float64)
    margin_m = np.maximum(_NOISE * depth_sigma_m(points[known][:, 2]), _LEAST_MARGIN_M)
    left = known.copy()
    left[known] = ~on_surround(points[known], around, margin_m)
    return left


def _weights(shape: tuple[int, ...]) -> FloatArray:
    """Return how much pixels (h, w) of a box count: those in its middle most."""
    sides = [1.1 - np.abs(np.linspace(-1, 1, n)) if n > 1 else np.ones(1) for n in shape]
    return np.outer(*sides)


def _enlarged(mask: BoolArray, shape: tuple[int, ...]) -> BoolArray:
    size = (shape[1], shape[0])
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)


def _closed(mask: BoolArray) -> BoolArray:
    """Return the mask without holes of single pixels, where depth is unknown."""
    disc = np.ones((3, 3), np.uint8)
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, disc).astype(np.bool_)
