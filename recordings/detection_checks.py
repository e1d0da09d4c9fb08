"""What keeps detected objects of another program from being used."""

from __future__ import annotations

import numpy as np

from mapstream.streams.arrays import BoolArray, finite_rows
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.vision import NO_TRACK

_UNIT = 1e-2  # how far from one the length of a descriptor may be; some are written with few digits


def detection_faults(message: ObjectDetections) -> list[str]:
    """Return what is wrong with a message as a whole; nothing if it can be used."""
    found = []
    if not message.frame:
        found.append("no `frame`; it names the camera, as the sensor file does")
    size_px, camera = (message.width_px, message.height_px), message.camera
    if min(size_px) <= 0 and camera is None:
        found.append(
            f"nobody says how large the images of {message.frame} are: neither the message nor a calibration"
        )
    if min(size_px) > 0 and camera and size_px != (camera.width_px, camera.height_px):
        found.append(
            f"it speaks of images of {size_px[0]} x {size_px[1]} px, where the calibration is of"
            f" {camera.width_px} x {camera.height_px} px"
        )
    return found


def object_faults(message: ObjectDetections) -> dict[str, BoolArray]:
    """Return which objects (N,) cannot be used, by reason; reasons without an object are left out."""
    boxes, size_px = message.boxes_px, np.array([message.width_px, message.height_px])
    low, high = boxes[:, :2], boxes[:, 2:]
    has_box = finite_rows(boxes)
    is_sized = size_px.min() > 0
    has_place = has_box if is_sized else has_box | _has_extent(message)  # it is projected first
    is_inside = ((high > -0.5) & (low < size_px - 0.5)).all(axis=1) | (not is_sized)
    found = {
        "the score is not between 0 and 1": ~((message.scores >= 0) & (message.scores <= 1)),
        "no class": np.array([not label for label in message.labels], bool),
        "neither a box in the image nor one in space before the camera": ~has_place,
        "the box has no area": has_box & ~(high > low).all(axis=1),
        "the box is outside of the image": has_box & ~is_inside,
        "a track id comes twice in one image; it names one object": _repeats(message),
        "a descriptor is not of unit length": _odd_descriptors(message),
    }
    return {reason: rows for reason, rows in found.items() if rows.any()}


def _has_extent(message: ObjectDetections) -> BoolArray:
    if message.centers_m is None or message.extents_m is None:
        return np.zeros(len(message), bool)
    return finite_rows(np.hstack([message.centers_m, message.extents_m]))


def _repeats(message: ObjectDetections) -> BoolArray:
    """Tell which objects have the track id of one before them."""
    repeats = np.zeros(len(message), bool)
    if message.track_ids is not None:
        _, first = np.unique(message.track_ids, return_index=True)
        repeats = np.asarray(message.track_ids != NO_TRACK)
        repeats[first] = False
    return repeats


def _odd_descriptors(message: ObjectDetections) -> BoolArray:
    if message.descriptors is None:
        return np.zeros(len(message), bool)
    lengths = np.linalg.norm(message.descriptors, axis=1)
    is_odd: BoolArray = np.abs(lengths - 1.0) > _UNIT  # NaN is none, which is no fault
    return is_odd
