"""The map drawn over the live image of a robot that is localised in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import anyio.to_thread
import cv2
import numpy as np
from pydantic import Field, PositiveFloat

from mapstream.operators.decode.image import ImageDecode, ImageDecodeConfig
from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.maps.overlay import Overlay, overlay
from mapstream.operators.operator import Operator, OperatorConfig, Placement, offload, warn
from mapstream.recordings.maps import Map, load_map
from mapstream.recordings.maps.cameras import Camera
from mapstream.streams.channel import Receiver, Sender
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.estimates import MapPose
from mapstream.streams.messages.sensors import CameraFrame
from mapstream.streams.sync import anchored, nearest

_POINT, _OUTLINE, _TEXT = (176, 255, 61), (233, 180, 86), (255, 255, 255)  # blue, green, red
_RADIUS_PX = 2
_TO_COLOR = ImageDecode(ImageDecodeConfig(mode="color"))


class MapOverlayConfig(OperatorConfig):
    """Options of `map_overlay`."""

    map: Path = Field(description="the map's folder")
    max_apart_s: PositiveFloat = 0.02
    """Between an image and the pose that it is drawn at."""


@dataclass(frozen=True)
class Inputs:
    """Images, and where the robot is in the map."""

    frames: Receiver[CameraFrame]
    poses: Receiver[MapPose]


@dataclass(frozen=True)
class Outputs:
    """Images in colour, with landmarks, outlines of planes and labels where the robot is localised."""

    frames: Sender[CameraFrame]


class MapOverlay(Operator[Inputs, Outputs]):
    """Draw what the map says is there over the image (augmented reality, as in OmniMapper's viewer).

    Images without a pose, or while the robot is lost, go through as they are, and are counted.
    """

    placement: ClassVar[Placement] = "thread"

    def __init__(self, config: MapOverlayConfig) -> None:
        self._config = config

    async def run(self, inputs: Inputs, outputs: Outputs) -> None:
        map_ = await anyio.to_thread.run_sync(load_map, self._config.map)
        within_ns = round(self._config.max_apart_s * 1e9)
        poses = nearest(inputs.poses, within_ns, optional=True)
        async for frame, pose in anchored(inputs.frames, poses):
            if pose is None or pose.T_map_base is None:
                warn("images of a time at which the robot is not localised")
                await outputs.frames.send(frame)
            else:
                await outputs.frames.send(await offload(drawn, frame, pose, map_))


def drawn(frame: CameraFrame, pose: MapPose, map_: Map) -> CameraFrame:
    """Return the image, bgr8, with the map over it.

    Raises:
        OperatorError: If the image says nothing of its camera, or has no colours and no grey of 8 bits.
    """
    if pose.T_map_base is None:
        return frame
    camera = Camera(calibration=require_camera(frame), T_base_sensor=frame.T_base_sensor)
    colored = _TO_COLOR.decode(frame)
    if not isinstance(colored, CameraFrame):
        raise OperatorError(f"the map cannot be drawn: {colored.reason}")
    image = np.array(colored.image, np.uint8)
    _draw(image, map_, overlay(map_, camera, pose.T_map_base))
    return replace(colored, image=image)


def _draw(
    image: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], map_: Map, shown: Overlay
) -> None:
    """Draw outlines, then points, then labels into the image."""
    for line in shown.outlines_px:
        corners = [np.round(line).astype(np.int32)]
        cv2.polylines(image, corners, isClosed=False, color=_OUTLINE, lineType=cv2.LINE_AA)
    at = np.round(shown.points_px).astype(np.int32)
    for x, y in at.tolist():
        cv2.circle(image, (x, y), _RADIUS_PX, _POINT, -1)
    labels = map_.landmarks.label[shown.landmarks].tolist()
    texts = [(label, at[row].tolist()) for row, label in enumerate(labels) if label]
    lines = zip(shown.outline_labels, shown.outlines_px, strict=True)
    texts += [(label, np.round(line[0]).astype(int).tolist()) for label, line in lines if label]
    for label, (x, y) in texts:
        place = (x + 2 * _RADIUS_PX, y)
        cv2.putText(image, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT, 1, cv2.LINE_AA)
