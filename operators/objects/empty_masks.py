"""Masks without a pixel, of which nothing can be made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapstream.operators.operator import warn
from mapstream.streams.messages.objects import ObjectDetections


def without_empty_masks(detections: ObjectDetections) -> ObjectDetections:
    """Return the objects, with the box in the place of each mask without a pixel, which is counted."""
    is_empty = [not mask.any() for mask in detections.masks]
    if not any(is_empty):
        return detections
    for _ in range(sum(is_empty)):
        warn(f"masks of {detections.frame} without a pixel; the box takes their place")
    sources = detections.mask_sources or ("model",) * len(is_empty)
    masks = zip(detections.masks, is_empty, strict=True)
    return replace(
        detections,
        masks=tuple(np.ones_like(mask) if empty else mask for mask, empty in masks),
        mask_sources=tuple(
            "box" if empty else source for source, empty in zip(sources, is_empty, strict=True)
        ),
    )
