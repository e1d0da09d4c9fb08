"""What the colour and depth camera of W-RGBD sees at some moments of its way round the room, with the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from mapstream.operators.decode.image import ImageDecode, ImageDecodeConfig
from mapstream.recordings.worlds.orbit import orbit
from mapstream.recordings.worlds.renderer import Rendering
from mapstream.recordings.worlds.rgbd_camera import RgbdCameraConfig
from mapstream.recordings.worlds.w_rgbd import (
    START_NS,
    T_BASE_CAMERA,
    RgbdWorld,
    WRgbdConfig,
    rgbd_world,
)
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame

_DURATION_S = 40.0


@dataclass(frozen=True, eq=False)
class RgbdView:
    """One moment."""

    color: CameraFrame
    depth: CameraFrame
    T_world_base: SE3
    ideal: Rendering


@cache
def world(width_px: int) -> RgbdWorld:
    """Return the room, and a camera whose images are so wide."""
    camera = RgbdCameraConfig(width_px=width_px, height_px=width_px * 3 // 4, format="png")
    return rgbd_world(WRgbdConfig(camera=camera, texel_m=0.02), seed=0)


@cache
def views(width_px: int, start_s: float, count: int, step_s: float = 0.1) -> tuple[RgbdView, ...]:
    """Return what is seen at moments after the start of the way, which takes 40 s."""
    seen = world(width_px).camera
    calibration = RgbdCameraConfig(width_px=width_px, height_px=width_px * 3 // 4).calibration
    stamps_ns = START_NS + np.round((start_s + step_s * np.arange(count)) * 1e9).astype(np.int64)
    decode = ImageDecode(ImageDecodeConfig(mode="gray"))
    found = []
    poses = orbit(_DURATION_S, START_NS).poses(stamps_ns)
    for number, (stamp_ns, T) in enumerate(zip(stamps_ns.tolist(), poses, strict=True)):
        T_world_camera = T @ T_BASE_CAMERA.matrix
        encoded, depth = seen.take(number, stamp_ns, T_world_camera)
        color = decode.decode(encoded)
        assert isinstance(color, CameraFrame)
        color = replace(color, camera=calibration("color"))
        depth = replace(depth, camera=calibration("depth"))
        found.append(RgbdView(color, depth, SE3(T), seen.ideal(T_world_camera)))
    return tuple(found)
