"""The way of W-RGBD: round a table with six things, a look round the room, and at the table again."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from mapstream.operators.objects.masks.object_masks import ObjectMasks, ObjectMasksConfig
from mapstream.operators.objects.tracking.object_tracker import ObjectTracker, ObjectTrackerConfig
from mapstream.recordings.worlds.orbit import orbit
from mapstream.recordings.worlds.rgbd_camera import RgbdCameraConfig
from mapstream.recordings.worlds.simulated_detector import SimulatedDetectorConfig
from mapstream.recordings.worlds.w_rgbd import START_NS, T_BASE_CAMERA, WRgbdConfig, w_rgbd
from mapstream.streams.messages.objects import ObjectDetections
from mapstream.streams.messages.sensors import CameraFrame
from tests.operators.objects.loops.drifted_walk import Walk


@cache
def walk(*, width_px: int = 160, rate_hz: float = 4.0, seed: int = 0) -> Walk:
    """Return the way with what a detector of few mistakes found, small images and few."""
    camera = RgbdCameraConfig(
        width_px=width_px, height_px=width_px * 3 // 4, rate_hz=rate_hz, format="png"
    )
    detector = SimulatedDetectorConfig(
        box_noise_px=width_px / 320, mask_noise_px=width_px / 640, min_pixels=width_px // 8
    )
    config = WRgbdConfig(camera=camera, texel_m=0.02, objects=detector)
    masks = ObjectMasks(ObjectMasksConfig())
    tracker = ObjectTracker(ObjectTrackerConfig(min_score=0.5, max_age_s=1.0))
    found: dict[int, ObjectDetections] = {}
    depth: dict[int, CameraFrame] = {}
    for record in w_rgbd(config, seed).records:
        if record.topic == "/color/objects" and isinstance(record.message, ObjectDetections):
            found[record.log_ns] = record.message
        elif record.topic == "/depth/image" and isinstance(record.message, CameraFrame):
            depth[record.log_ns] = record.message
    calibration = camera.calibration("color")
    seen = []
    for stamp_ns in sorted(found):
        objects = replace(found[stamp_ns], camera=calibration, T_base_sensor=T_BASE_CAMERA)
        seen.append(tracker.track(masks.with_masks(objects, depth[stamp_ns])))
    stamps_ns = np.array([objects.stamp_ns for objects in seen])
    return Walk(orbit(config.duration_s, START_NS).poses(stamps_ns), seen)
