"""Some of the objects of an image: all that is known of each stays with it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.streams.messages.objects import ObjectDetections

_ARRAYS = (
    "boxes_px",
    "scores",
    "centers_m",
    "center_sigmas_m",
    "quats_camera_object_xyzw",
    "extents_m",
    "descriptors",
    "track_ids",
)
_TUPLES = ("labels", "masks", "mask_sources", "points_m", "texts")


def rows_of(
    objects: ObjectDetections, rows: npt.NDArray[np.integer | np.bool_]
) -> ObjectDetections:
    """Return the objects of a mask (N,), or of indices (M,) in their order."""
    indices = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
    chosen: dict[str, Any] = {}
    for name in _ARRAYS:
        array = getattr(objects, name)
        chosen[name] = None if array is None else array[indices]
    for name in _TUPLES:
        parts = getattr(objects, name)
        chosen[name] = tuple(parts[row] for row in indices.tolist()) if parts else ()
    return replace(objects, **chosen)
