"""Where something hides what is behind it: the outlines of things in a depth image.

An outline belongs to the nearer side; the farther one only ends where it is hidden.
Source: Choi, Trevor, Christensen: RGB-D Edge Detection and Edge-Based Registration, IROS 2013, section III-A.
"""

from __future__ import annotations

import cv2
import numpy as np

from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray
from mapstream.streams.structured_light import depth_sigma_m

_SIGMAS = 3.0  # of the noise of depth that a jump exceeds
_MEDIAN_PX = 5  # of the filter that takes noise and leaves jumps
_SLOPE_PX = 4  # along which the slope of the nearer surface is measured


def occluding_edges(depth_m: Float32Array, *, jump_m: float, max_gap_px: int) -> Float32Array:
    """Return the depth (H, W) [m] where something lies farther away beside a pixel, NaN elsewhere.

    It is the median around. Farther is what is farther than the nearer surface would be if it went on, so that a floor seen aslant has none.

    Args:
        depth_m: Along the view (H, W); NaN: unknown.
        jump_m: Between both sides, at least.
        max_gap_px: Of unknown depth between both sides: structured light casts a shadow there.
    """
    inverse = _smooth(np.nan_to_num(1 / depth_m))
    least_m = np.maximum(jump_m, _SIGMAS * depth_sigma_m(depth_m.astype(np.float64)))
    found = np.zeros(depth_m.shape, np.bool_)
    for turns in range(4):  # the farther side is to the right, in images turned so
        turned = np.rot90(inverse, turns)
        is_edge = _hides_right(turned, np.rot90(least_m, turns), max_gap_px)
        found |= np.rot90(is_edge, -turns)
    with np.errstate(divide="ignore"):
        return np.where(found, 1 / inverse, np.nan).astype(np.float32)


def _smooth(inverse: Float32Array) -> Float32Array:
    """Return the medians around each pixel; 0 where depth is unknown."""
    median = np.asarray(cv2.medianBlur(inverse, _MEDIAN_PX), np.float32)
    return np.where((inverse > 0) & (median > 0), median, 0).astype(np.float32)


def _hides_right(inverse: Float32Array, least_m: FloatArray, max_gap_px: int) -> BoolArray:
    """Return the pixels (H, W) whose next known neighbour to the right lies farther away."""
    beyond, distance_px = _next_known(inverse)
    slope = np.zeros_like(inverse)
    before = inverse[:, :-_SLOPE_PX]
    slope[:, _SLOPE_PX:] = np.where(before > 0, inverse[:, _SLOPE_PX:] - before, 0) / _SLOPE_PX
    with np.errstate(divide="ignore", invalid="ignore"):
        # inverse depth goes on linearly along a plane
        expected_m = 1 / np.maximum(inverse + slope * distance_px, 1e-3)
        nearer_m = np.maximum(1 / inverse, expected_m)
        is_edge = 1 / beyond - nearer_m > least_m
    return (inverse > 0) & (beyond > 0) & (distance_px <= max_gap_px) & is_edge


def _next_known(inverse: Float32Array) -> tuple[Float32Array, FloatArray]:
    """Return of each pixel the next known value to the right, 0 if there is none, and how far it is [px]."""
    width = inverse.shape[1]
    columns = np.where(inverse > 0, np.arange(width), width)
    following = np.minimum.accumulate(columns[:, ::-1], axis=1)[:, ::-1]  # itself, if known
    following = np.concatenate([following[:, 1:], np.full((len(inverse), 1), width)], axis=1)
    values = np.take_along_axis(inverse, np.minimum(following, width - 1), axis=1)
    values = np.where(following < width, values, 0)
    return values.astype(np.float32), (following - np.arange(width)).astype(np.float64)
