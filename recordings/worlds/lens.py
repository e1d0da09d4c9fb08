"""What a calibrated camera sees of a world: any model and distortion, rolling shutters, motion blur.

The world is drawn by a pinhole that covers the view, and bent by a look-up of each pixel's ray. A rolling shutter is
drawn in bands of rows, each from where the camera is when its middle row is exposed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from mapstream.recordings.worlds.paint import Picture
from mapstream.recordings.worlds.renderer import Pinhole, Renderer
from mapstream.streams.arrays import Float32Array, FloatArray, IntArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import unproject

_BAND_ROWS = 8  # half of it at 1 rad/s and 20 ms per image: 0.07 px
_MAX_SLOPE = 3.5  # of rays; a pinhole that covers more wastes most of its pixels


@dataclass(frozen=True, slots=True, eq=False)
class _Band:
    """Rows that are exposed at one time, and the pinhole that covers them."""

    rows: slice
    pinhole: Pinhole
    look_up: Float32Array  # (2, H, W) pixels of the pinhole; empty if they are the same


class Lens:
    """One camera that looks at one world."""

    def __init__(self, renderer: Renderer, camera: CameraCalibration) -> None:
        """Prepare the look-up.

        Raises:
            ValueError: If pixels see nothing, or look too far aside.
        """
        self.camera = camera
        self._renderer = renderer
        height = camera.height_px
        step = _BAND_ROWS if camera.line_delay_ns else height
        slopes = None if _is_pinhole(camera) else _slopes(camera)
        self._bands = [
            _band(camera, slice(row, min(row + step, height)), slopes)
            for row in range(0, height, step)
        ]

    @property
    def offsets_ns(self) -> IntArray:
        """Return when after an image's stamp its bands are exposed (B,)."""
        middles = [(band.rows.start + band.rows.stop - 1) / 2 for band in self._bands]
        offsets: IntArray = np.rint(np.array(middles) * self.camera.line_delay_ns).astype(np.int64)
        return offsets

    def image(self, T_world_camera: FloatArray) -> Picture:
        """Return an image from poses of the bands (B, 4, 4), or of several moments (S, B, 4, 4) blurred."""
        moments = T_world_camera.reshape(-1, len(self._bands), 4, 4)
        if len(moments) == 1:
            return self._sharp(moments[0])
        mean = np.mean([self._sharp(poses) for poses in moments], axis=0, dtype=np.float32)
        blurred: Picture = np.rint(mean).astype(np.uint8)
        return blurred

    def surfaces(self, T_world_camera: FloatArray) -> IntArray:
        """Return which surface each pixel (H, W) of a global shutter shows, from a pose (4, 4)."""
        parts = [self._shown(band, T_world_camera) for band in self._bands]
        return np.concatenate(parts)

    def _shown(self, band: _Band, T_world_camera: FloatArray) -> IntArray:
        shown = self._renderer.surfaces_seen(band.pinhole, T_world_camera)
        if not band.look_up.size:
            return shown
        small = shown.astype(np.int16)  # what OpenCV can bend
        bent = cv2.remap(small, band.look_up[0], band.look_up[1], cv2.INTER_NEAREST)
        return bent.astype(np.int64)

    def _sharp(self, poses: FloatArray) -> Picture:
        parts = [self._part(band, T) for band, T in zip(self._bands, poses, strict=True)]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def _part(self, band: _Band, T_world_camera: FloatArray) -> Picture:
        drawn = self._renderer.image(band.pinhole, T_world_camera)
        if not band.look_up.size:
            return drawn
        bent = cv2.remap(drawn, band.look_up[0], band.look_up[1], cv2.INTER_LINEAR)
        return bent.astype(np.uint8, copy=False)


def _is_pinhole(camera: CameraCalibration) -> bool:
    return camera.distortion == "none" and not camera.xi


def _slopes(camera: CameraCalibration) -> FloatArray:
    """Return x / z and y / z of all pixels' rays (H, W, 2)."""
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = unproject(camera, np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64))
    slopes = rays[:, :2] / np.where(rays[:, 2:] > 0, rays[:, 2:], np.nan)
    widest = np.abs(slopes).max()
    if not widest <= _MAX_SLOPE:  # also if there is a NaN
        raise ValueError(
            f"{camera.frame}: pixels at the image's border look too far aside, or nowhere;"
            " take a longer focal length or less distortion"
        )
    return slopes.reshape(camera.height_px, camera.width_px, 2)


def _band(camera: CameraCalibration, rows: slice, slopes: FloatArray | None) -> _Band:
    fx, fy = camera.focal_px.tolist()
    if slopes is None:
        cx, cy = camera.center_px.tolist()
        size = (camera.width_px, rows.stop - rows.start)
        return _Band(
            rows, Pinhole((fx, fy), (cx, cy - rows.start), size), np.empty((2, 0, 0), np.float32)
        )
    part = slopes[rows]
    focal = fx / (1 + (camera.xi or 0.0))  # as fine as the lens is in its middle
    low, high = part.min(axis=(0, 1)) * focal, part.max(axis=(0, 1)) * focal
    width, height = (np.ceil(high - low).astype(int) + 3).tolist()
    center = 1 - low
    look_up = np.moveaxis((part * focal + center).astype(np.float32), 2, 0)
    pinhole = Pinhole((focal, focal), (float(center[0]), float(center[1])), (width, height))
    return _Band(rows, pinhole, look_up)
