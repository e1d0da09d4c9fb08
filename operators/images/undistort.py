"""The lens's distortion taken out of images."""

from __future__ import annotations

from pydantic import Field, PositiveFloat

from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.frame_filter import FrameFilter
from mapstream.operators.images.pinhole_maps import (
    PinholeMap,
    calibration_key,
    pinhole_like,
    pinhole_map,
)
from mapstream.operators.operator import OperatorConfig
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.messages.sensors import CameraFrame


class UndistortConfig(OperatorConfig):
    """Options of `undistort`."""

    zoom: PositiveFloat = Field(
        default=1.0,
        description="size of things in the middle of the image, against the original; less shows more"
        " of what lies near the border",
    )


class Undistort(FrameFilter):
    """Make images those of a pinhole camera without distortion, of the same size and place."""

    def __init__(self, config: UndistortConfig) -> None:
        self._zoom = config.zoom
        self._maps: dict[tuple[object, ...], PinholeMap] = {}

    def changed(self, frame: CameraFrame) -> CameraFrame:
        return self._map(require_camera(frame)).warped(frame)

    def _map(self, camera: CameraCalibration) -> PinholeMap:
        key = calibration_key(camera)
        if key not in self._maps:
            self._maps[key] = pinhole_map(camera, pinhole_like(camera, self._zoom))
        return self._maps[key]
