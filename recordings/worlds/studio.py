"""The cameras of W-VI at work: which images are taken when, and what comes out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from mapstream.recordings.worlds.lens import Lens
from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.paint import Picture
from mapstream.recordings.worlds.photographs import Film, compress, in_order
from mapstream.recordings.worlds.renderer import Renderer
from mapstream.recordings.worlds.vi_rig import T_BASE_CAMERA, CameraName, ViCameraConfig
from mapstream.streams.arrays import IntArray
from mapstream.streams.errors import ConfigError
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import EncodedImage

_GREY = 128
_FILM = 7  # apart from all that takes chance from the seed alone


@dataclass(frozen=True, slots=True)
class Shot:
    """One image to take."""

    camera: CameraName
    number: int  # of the image, from this camera
    since_start_ns: int
    taken_ns: int


class Studio:
    """The cameras of one flight. An image is the same whichever is drawn first."""

    def __init__(
        self,
        config: ViCameraConfig,
        claims: Mapping[CameraName, SE3],
        renderer: Renderer,
        motion: Motion,
        seed: int,
        places: Mapping[CameraName, SE3] = T_BASE_CAMERA,
    ) -> None:
        """Set up the cameras that have a claim: where the recording says that they sit, and where they do.

        Raises:
            ConfigError: If a lens cannot be drawn.
        """
        self._config, self._claims, self._motion = config, claims, motion
        self._places = places
        shape = (config.height_px, config.width_px)
        try:
            self._lenses = {name: Lens(renderer, config.calibration(name)) for name in claims}
        except ValueError as error:
            raise ConfigError(f"w_vi.camera: {error}") from error
        self._films = {
            name: Film(shape, config.noise, (seed, _FILM, number))
            for number, name in enumerate(T_BASE_CAMERA)
            if name in claims
        }

    def images(self, stamps_ns: IntArray) -> Iterator[tuple[Shot, EncodedImage]]:
        """Yield the images of all cameras at each stamp, the first of which is the flight's start."""
        shots = (
            Shot(name, number, stamp_ns - int(stamps_ns[0]), stamp_ns)
            for number, stamp_ns in enumerate(stamps_ns.tolist())
            for name in self._lenses
        )
        return in_order(self._take, shots)

    def _take(self, shot: Shot) -> tuple[Shot, EncodedImage]:
        config = self._config
        exposed = self._films[shot.camera].expose(self.picture(shot), shot.number)
        image = EncodedImage(
            stamp_ns=shot.taken_ns + round(config.time_offset_s * 1e9),
            data=compress(exposed, config.format, config.quality),
            format=config.format,
            frame=shot.camera,
            T_base_sensor=self._claims[shot.camera],
        )
        return shot, image

    def picture(self, shot: Shot) -> Picture:
        """Return what a camera sees, as an ideal lens without noise draws it."""
        kind = self._config.blindness_of(shot.camera, shot.since_start_ns / 1e9)
        if kind is not None:
            level = 0 if kind == "black" else _GREY
            return np.full((self._config.height_px, self._config.width_px), level, np.uint8)
        lens, exposure_ns = self._lenses[shot.camera], self._config.exposure_s * 1e9
        moments = np.zeros(1)
        if exposure_ns:
            moments = np.linspace(-0.5, 0.5, self._config.blur_samples) * exposure_ns
        stamps_ns = shot.taken_ns + np.rint(moments)[:, None].astype(np.int64) + lens.offsets_ns
        T_world_camera = self._motion.poses(stamps_ns.ravel()) @ self._places[shot.camera].matrix
        return lens.image(T_world_camera.reshape(*stamps_ns.shape, 4, 4))
