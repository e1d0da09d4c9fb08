"""Keypoints of an image, some of a message, or those of two: all that is known of each stays with it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from mapstream.operators.objects.rows import rows_of as objects_of
from mapstream.streams.arrays import Float32Array
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.messages.vision import ImageFeatures

_OPTIONAL = (
    "scores",
    "scales",
    "orientations_rad",
    "sigmas_px",
    "track_ids",
    "points_m",
    "point_sigmas_m",
    "offsets_ns",
)


def features_in(
    frame: CameraFrame,
    kind: str,
    px: Float32Array,
    **known: Any,  # noqa: ANN401  # fields of ImageFeatures
) -> ImageFeatures:
    """Return keypoints (N, 2) of an image, with what is known of each; camera, place and record are the image's."""
    return ImageFeatures(
        stamp_ns=frame.stamp_ns,
        kind=kind,
        frame=frame.frame,
        keypoints_px=px,
        T_base_sensor=frame.T_base_sensor,
        camera=frame.camera,
        record=frame.record,
        **known,
    )


def rows_of(features: ImageFeatures, rows: npt.NDArray[Any]) -> ImageFeatures:
    """Return the keypoints of a mask (N,), or of indices (M,) in their order."""
    chosen: dict[str, Any] = {"descriptors": features.descriptors[rows]}
    for name in _OPTIONAL:
        array = getattr(features, name)
        chosen[name] = None if array is None else array[rows]
    if features.objects is not None:
        chosen["objects"] = objects_of(features.objects, rows)
    return replace(features, keypoints_px=features.keypoints_px[rows], **chosen)


def appended(first: ImageFeatures, second: ImageFeatures) -> ImageFeatures:
    """Return the first message with the keypoints of the second behind its own.

    What only one of the two knows of its keypoints is left out, and objects are; a message without keypoints has no say.
    """
    if len(second) == 0:
        return first
    joined: dict[str, Any] = {"objects": None if len(first) else second.objects}
    for name in ("keypoints_px", "descriptors", *_OPTIONAL):
        a, b = getattr(first, name), getattr(second, name)
        if len(first) == 0:
            joined[name] = b
        else:
            joined[name] = None if a is None or b is None else np.concatenate([a, b])
    return replace(first, kind=second.kind, **joined)
