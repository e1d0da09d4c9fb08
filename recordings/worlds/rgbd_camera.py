"""A simulated camera of colour and depth, whose pixels are the same: ideal, and with noise."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat

from mapstream.recordings.worlds.depth_camera import with_depth_noise
from mapstream.recordings.worlds.people import People
from mapstream.recordings.worlds.photographs import Film, compress
from mapstream.recordings.worlds.renderer import Pinhole, Renderer, Rendering
from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame, EncodedImage, OrganizedCloud

COLOR, DEPTH = "color", "depth"
_FILM, _DEPTH_NOISE = 7, 8  # apart from all that takes chance from the seed alone
_NOISE = 1.5  # of colours [grey levels]


class RgbdCameraConfig(BaseModel):
    """A camera without distortion."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    width_px: int = Field(default=640, ge=32)
    height_px: int = Field(default=480, ge=24)
    focal_px: PositiveFloat | None = None
    """Kinect's where nothing is said: 525 px at a width of 640."""
    rate_hz: PositiveFloat = 10.0
    min_depth_m: NonNegativeFloat = 0.5
    max_depth_m: PositiveFloat = 4.5
    noise: NonNegativeFloat = 1.0
    """Of depths, times that of structured light."""
    format: Literal["jpeg", "png"] = "jpeg"
    quality: int = Field(default=90, ge=1, le=100)
    """Of JPEG."""
    clouds: bool = False
    """Writes `/points` as well: the same depths and colours as organised clouds."""

    def calibration(self, frame: str) -> CameraCalibration:
        """Return how the camera sees, under the name of either of its images."""
        focal = self.focal_px or self.width_px * 525 / 640
        return CameraCalibration(
            frame=frame,
            width_px=self.width_px,
            height_px=self.height_px,
            focal_px=np.array([focal, focal]),
            center_px=(np.array([self.width_px, self.height_px]) - 1) / 2,
            distortion_parameters=np.zeros(0),
        )


class RgbdCamera:
    """One camera in one world. A view is the same whichever is taken first."""

    def __init__(
        self,
        config: RgbdCameraConfig,
        renderer: Renderer,
        T_base_camera: SE3,
        seed: int,
        people: People | None = None,
    ) -> None:
        self._config, self._renderer, self._seed = config, renderer, seed
        self._people = people
        self._T_base_camera = T_base_camera
        lens = config.calibration(COLOR)
        (fx, fy), (cx, cy) = lens.focal_px.tolist(), lens.center_px.tolist()
        self._pinhole = Pinhole((fx, fy), (cx, cy), (lens.width_px, lens.height_px))
        self._film = Film((lens.height_px, lens.width_px, 3), _NOISE, (seed, _FILM))
        u = (np.arange(lens.width_px) - cx) / fx
        v = (np.arange(lens.height_px) - cy) / fy
        self._rays = np.stack([*np.meshgrid(u, v), np.ones((len(v), len(u)))], axis=2)  # of depth 1

    def ideal(self, T_world_camera: FloatArray) -> Rendering:
        """Return what is seen of the room from a pose (4, 4), without noise: colours, inverse depths, surfaces."""
        return self._renderer.rendering(self._pinhole, T_world_camera)

    def ideal_at(self, stamp_ns: int, T_world_camera: FloatArray) -> Rendering:
        """Return what is seen from a pose (4, 4) at a time, without noise: the room and the people in it."""
        view = self.ideal(T_world_camera)
        if self._people is None:
            return view
        return self._people.in_front_of(view, self._pinhole, stamp_ns, T_world_camera)

    def take(
        self, number: int, stamp_ns: int, T_world_camera: FloatArray
    ) -> tuple[EncodedImage, CameraFrame]:
        """Return the colour and the depth image with a number, of a pose (4, 4)."""
        return self.images(self.ideal_at(stamp_ns, T_world_camera), number, stamp_ns)

    def images(
        self, view: Rendering, number: int, stamp_ns: int
    ) -> tuple[EncodedImage, CameraFrame]:
        """Return the colour and the depth image with a number, of what is seen without noise."""
        config = self._config
        color = EncodedImage(
            stamp_ns=stamp_ns,
            data=compress(self._film.expose(view.image, number), config.format, config.quality),
            format=config.format,
            frame=COLOR,
            T_base_sensor=self._T_base_camera,
        )
        depth = CameraFrame(
            stamp_ns=stamp_ns,
            image=self._measured_mm(view, number),
            encoding="16UC1",
            frame=DEPTH,
            T_base_sensor=self._T_base_camera,
        )
        return color, depth

    def _measured_mm(self, view: Rendering, number: int) -> npt.NDArray[np.uint16]:
        config = self._config
        rng = np.random.default_rng((self._seed, _DEPTH_NOISE, number))
        with np.errstate(divide="ignore"):
            depth_m = 1 / view.inverse_depths.astype(np.float64)
        seen = (depth_m >= config.min_depth_m) & (depth_m <= config.max_depth_m)
        depth_m = with_depth_noise(np.where(seen, depth_m, 0.0), config.noise, rng)
        measured: npt.NDArray[np.uint16] = np.rint(1000 * np.where(seen, depth_m, 0.0)).astype(
            np.uint16
        )
        return measured

    def cloud(self, color: EncodedImage, depth: CameraFrame) -> OrganizedCloud:
        """Return a colour and a depth image as the points of their pixels."""
        depth_m = depth.image / 1000.0
        points = self._rays * np.where(depth_m > 0, depth_m, np.nan)[:, :, None]
        bgr = np.asarray(cv2.imdecode(color.data, cv2.IMREAD_COLOR), np.uint8)
        return OrganizedCloud(
            stamp_ns=depth.stamp_ns,
            points=points.astype(np.float32),
            colors_rgb=np.ascontiguousarray(bgr[:, :, ::-1]),
            frame=DEPTH,
            T_base_sensor=self._T_base_camera,
        )
