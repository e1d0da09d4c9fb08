"""What of a box is the object, and what its points say of its place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.structured_light import depth_sigma_m

_INNER = (5.0, 95.0)  # percentiles between which an object lies
_THICKNESS = 0.15  # of its smaller side: so unsure is how far an object goes on behind what is seen


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """The part of a box that is the object."""

    mask: BoolArray  # (h, w) over the pixels of the box
    points: FloatArray  # (K, 3) on it, in the camera frame [m]
    source: str  # one of MASK_SOURCES


def network_mask(detections: ObjectDetections, row: int) -> BoolArray | None:
    """Return the mask (h, w) that a network gave; None if it gave none, or an empty one."""
    if not detections.masks or detections.mask_sources[row] != "model":
        return None
    mask = detections.masks[row]
    return mask if mask.any() else None


def unsegmented(detections: ObjectDetections, row: int) -> Segment:
    """Return what is known of an object without depth: the mask that a network gave, or the whole box."""
    given = network_mask(detections, row)
    shape = tuple(part.stop - part.start for part in detections.window(row))
    none = np.empty((0, 3))
    return Segment(np.ones(shape, np.bool_), none, "box") if given is None else Segment(given, none, "model")  # fmt: skip


def sampled(points: FloatArray, max_points: int) -> Float32Array:
    """Return at most so many of the points (K, 3), evenly spread over their order."""
    if len(points) > max_points:
        rows = np.linspace(0, len(points) - 1, max_points).round().astype(np.int64)
        points = points[rows]
    return points.astype(np.float32)


def center_of(points: FloatArray) -> tuple[FloatArray, float]:
    """Return the middle (3,) of an object with these points (K, 3), and how sure it is along each axis [m].

    It is half way between the near and the far end of what is seen, on the ray through the middle of what is seen:
    the mean of points would lie nearer to the camera, and nearer to the side that shows more.
    """
    if not len(points):
        return np.full(3, np.nan), np.nan
    (near, far), rays = np.percentile(points[:, 2], _INNER), points[:, :2] / points[:, 2:]
    low, high = np.percentile(rays, _INNER, axis=0)
    depth_m = (near + far) / 2
    sides_m = (high - low) * depth_m
    center = np.append((low + high) / 2, 1.0) * depth_m
    return center, float(np.hypot(depth_sigma_m(depth_m), _THICKNESS * sides_m.min()))
