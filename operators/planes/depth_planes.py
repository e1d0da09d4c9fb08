"""Planes in a depth image, by organised connected components.

Neighbouring pixels whose local planes are alike are one region; a region that is large enough is a plane, which
then grows to the pixels around it that lie on it as well: those at its border, where no window was flat.
Source: Trevor, Gedikli, Rusu, Christensen: Efficient organized point cloud segmentation with connected components,
SPME 2013.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import norm

from mapstream.operators.planes.image_planes import ImagePlanes, fitted
from mapstream.operators.planes.local_planes import DepthGrid, local_planes
from mapstream.operators.planes.regions import Labels, plane_regions, same_label_regions
from mapstream.streams.arrays import FloatArray

_STEP = 2  # every so many rows and columns are compared
_MOST_CHI2 = 2.0  # of a window that is flat
_SEED = 0.25  # of the pixels of a plane are there before it grows
_LEAST_TOLD = 20  # flat places that tell the plane of a region
_NUM_SIGMAS = 3.0  # that a pixel may lie off its plane


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentationLimits:
    """What makes a plane."""

    angle_rad: float
    distance_m: float
    window_px: int
    min_pixels: int


def depth_planes(grid: DepthGrid, limits: SegmentationLimits) -> tuple[ImagePlanes, Labels]:
    """Return the planes of an image, the largest first, and the label (H, W) of each pixel: 0, none, or 1 to N."""
    local = local_planes(grid, window_px=limits.window_px, step=_STEP, most_chi2=_MOST_CHI2)
    coarse = grid.every(_STEP)
    found = plane_regions(coarse, local, angle_rad=limits.angle_rad, distance_m=limits.distance_m)
    seeds, count = _largest_first(found, limits.min_pixels * _SEED / _STEP**2)
    planes = fitted(coarse, seeds, count)
    surface_of, surfaces = _surfaces(planes, limits)
    grown = same_label_regions(_nearest(grid, surfaces, limits.distance_m), surface_of[seeds])
    labels, count = _largest_first(grown, limits.min_pixels)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    near = labels[::_STEP, ::_STEP]
    inside = np.where(seeds > 0, near, 0)  # where windows were flat
    is_told = np.bincount(inside.ravel(), minlength=count + 1) >= _LEAST_TOLD
    inside = np.where(is_told[near], inside, near)  # nowhere flat enough: by all that lies on it
    return replace(fitted(coarse, inside, count), num_pixels=sizes.astype(np.int64)), labels


def _largest_first(labels: Labels, least: float) -> tuple[Labels, int]:
    """Return labels anew for the regions with so many pixels or more, by size, and their number."""
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    kept = np.argsort(-sizes, kind="stable")[: int((sizes >= max(least, 3)).sum())]
    anew = np.zeros(len(sizes), np.int32)
    anew[kept] = np.arange(1, len(kept) + 1)
    return anew[labels], len(kept)


def _surfaces(planes: ImagePlanes, limits: SegmentationLimits) -> tuple[Labels, FloatArray]:
    """Return the surface of each label, 0 for none, and its q: regions of one floor lie on one surface."""
    normals = planes.normals
    points = planes.mean_rays / np.einsum("ni,ni->n", planes.q, planes.mean_rays)[:, None]
    firsts: list[int] = []
    surface_of = np.zeros(len(planes) + 1, np.int32)
    for row in range(len(planes)):
        q = planes.q[firsts]
        off_m = np.abs(q @ points[row] - 1) / np.linalg.norm(q, axis=1)
        is_same = (normals[firsts] @ normals[row] > np.cos(limits.angle_rad)) & (
            off_m < limits.distance_m
        )
        if not is_same.any():
            firsts.append(row)
        surface_of[row + 1] = np.argmax(is_same) + 1 if is_same.any() else len(firsts)
    return surface_of, planes.q[firsts]


def _nearest(grid: DepthGrid, surfaces: FloatArray, distance_m: float) -> Labels:
    """Return which surface each pixel lies on, from 1 on; 0 if on none."""
    w = grid.inverse_depth
    nearest = np.where(w > 0, np.float32(1.0), np.float32(0.0))  # off it, over what is allowed
    labels = np.zeros(w.shape, np.int32)
    for number, q in enumerate(surfaces.astype(np.float32), start=1):
        allowed = np.maximum(_NUM_SIGMAS * grid.sigma, np.float32(distance_m) * norm(q) * w)
        off = np.abs(q[0] * grid.x + q[1] * grid.y + q[2] - w)
        is_nearer = off < nearest * allowed
        labels[is_nearer] = number
        nearest[is_nearer] = off[is_nearer] / allowed[is_nearer]
    return labels
