"""Where in an image the middle of a thing is: not quite in the middle of its box.

A box is around what is seen of a thing from one side, in perspective, and as far as the image goes.
What all views saw of the thing tells which box that is, and how far its middle is off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapstream.operators.landmarks.views import by_camera
from mapstream.operators.objects.landmarks.boxes import UprightBox
from mapstream.operators.objects.landmarks.sightings import Sightings
from mapstream.recordings.maps.cameras import Camera
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.camera_models import project

_DIRECTIONS = np.random.default_rng(0).normal(size=(200, 3))  # in which a thing has an end


def with_middles(
    map_: Map,
    sightings: Sightings,
    members: Sequence[IntArray],
    boxes: Sequence[UprightBox | None],
) -> Map:
    """Return the map with the keypoints of sightings at the middles of things.

    They are at the middles of their boxes where the shape of a thing is not known, so that what was found before
    does not matter.

    Args:
        map_: The map.
        sightings: All of its sightings.
        members: Which of them show each thing.
        boxes: Where each thing is, in the map.
    """
    rows = sightings.views.rows
    middles_px = (sightings.boxes_px[:, :2] + sightings.boxes_px[:, 2:]) / 2
    for camera, own in by_camera(map_, rows):
        for shown, box in zip(members, boxes, strict=True):
            if box is not None:
                in_camera = np.intersect1d(shown, own)
                T_map_camera = sightings.views.T_map_sensor[in_camera]
                middles_px[in_camera] -= _offsets_px(camera, T_map_camera, box)
    keypoint_px = map_.observations.keypoint_px.copy()
    has_pixel = np.isfinite(keypoint_px[rows]).all(axis=1)
    keypoint_px[rows[has_pixel]] = middles_px[has_pixel]
    return replace(map_, observations=replace(map_.observations, keypoint_px=keypoint_px))


def _offsets_px(camera: Camera, T_map_camera: FloatArray, box: UprightBox) -> FloatArray:
    """Return how far (N, 2) the middle of the image's box is from that of the thing; 0 where a part has no pixel."""
    ends = np.unique((box.points @ _DIRECTIONS.T).argmax(axis=0))
    points = np.vstack([box.center, box.points[ends]])
    in_camera = (points - T_map_camera[:, None, :3, 3]) @ T_map_camera[:, :3, :3]  # (N, K, 3)
    px, is_seen = project(camera.calibration, in_camera.reshape(-1, 3))
    px, is_seen = px.reshape(*in_camera.shape[:2], 2), is_seen.reshape(in_camera.shape[:2])
    last_px = np.array([camera.calibration.width_px, camera.calibration.height_px]) - 0.5
    low, high = (end(px[:, 1:], axis=1).clip(-0.5, last_px) for end in (np.min, np.max))
    middle_px = (low + high) / 2
    offsets_px: FloatArray = np.where(is_seen.all(axis=1, keepdims=True), middle_px - px[:, 0], 0.0)
    return offsets_px
