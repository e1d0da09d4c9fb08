"""How well detections say where the middle of an object is, in the image and in space."""

from __future__ import annotations

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from mapstream.operators.landmarks.views import POINT_SIGMA_M
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.arrays import BoolArray, FloatArray
from mapstream.streams.messages.objects import ObjectDetections


class CertaintyOptions(OperatorConfig):
    """How sure the middle of an object is."""

    sigma_share: PositiveFloat = 0.05
    """Uncertainty of the middle of an object, as a share of its box's longer side."""
    least_sigma_px: PositiveFloat = 1.0
    cut_sigma_share: PositiveFloat = 0.5
    """The same where the border of the image cuts the object: its middle may be far from the box's."""
    border_px: NonNegativeFloat = 2.0
    """An object whose box is so near to the border of the image counts as cut."""


def is_cut(detections: ObjectDetections, border_px: float) -> BoolArray:
    """Return which objects (N,) the border of the image cuts, or may cut."""
    last_px = np.array([detections.width_px, detections.height_px]) - 0.5
    boxes = detections.boxes_px
    low, high = boxes[:, :2] < border_px - 0.5, boxes[:, 2:] > last_px - border_px
    cut: BoolArray = np.asarray((low | high).any(axis=1))
    return cut


def middle_sigmas_px(detections: ObjectDetections, options: CertaintyOptions) -> FloatArray:
    """Return how sure the middles of the boxes (N,) are those of the objects [px]."""
    boxes = detections.boxes_px.astype(np.float64)
    sides_px = (boxes[:, 2:] - boxes[:, :2]).max(axis=1, initial=0)
    cut = is_cut(detections, options.border_px)
    share = np.where(cut, options.cut_sigma_share, options.sigma_share)
    sigmas_px: FloatArray = np.maximum(share * sides_px, options.least_sigma_px)
    return sigmas_px


def center_sigmas_m(detections: ObjectDetections, options: CertaintyOptions) -> FloatArray:
    """Return how sure the centres (N,) are, along each axis [m].

    What the border cuts is off in space by as much as its middle is in the image.

    Raises:
        ValueError: If the detections have no centres.
    """
    if detections.centers_m is None:
        raise ValueError("detections without centres have no sigmas of them")
    given = detections.center_sigmas_m
    sigmas_m = np.full(len(detections), np.nan) if given is None else given.astype(np.float64)
    sigmas_m = np.where(np.isfinite(sigmas_m), sigmas_m, POINT_SIGMA_M)
    off_m = middle_sigmas_px(detections, options) * _m_per_px(detections)
    return np.where(is_cut(detections, options.border_px), np.hypot(sigmas_m, off_m), sigmas_m)


def sizes_m(detections: ObjectDetections) -> FloatArray:
    """Return the longer sides of the boxes (N,) at the depth of the objects [m]; 0 where that is not known."""
    boxes = detections.boxes_px.astype(np.float64)
    sides_px: FloatArray = (boxes[:, 2:] - boxes[:, :2]).max(axis=1, initial=0)
    return sides_px * _m_per_px(detections)


def _m_per_px(detections: ObjectDetections) -> FloatArray:
    """Return how wide a pixel is at the depth of each object (N,); 0 where that is not known."""
    if detections.camera is None or detections.centers_m is None:
        return np.zeros(len(detections))
    depths_m = np.nan_to_num(detections.centers_m[:, 2].astype(np.float64))
    widths_m: FloatArray = depths_m / detections.camera.focal_px.mean()
    return widths_m
