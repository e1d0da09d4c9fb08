"""What a depth camera saw from one pose, as it enters a volume: a pinhole camera without distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mapstream.operators.images.calibrated import require_camera
from mapstream.operators.images.depth import depth_m_of
from mapstream.operators.images.frame_filter import require_encoding
from mapstream.operators.images.pinhole_maps import (
    PinholeMap,
    calibration_key,
    pinhole_like,
    pinhole_map,
)
from mapstream.streams.arrays import BoolArray, Float32Array, FloatArray, IntArray, frozen
from mapstream.streams.messages.sensors import CameraFrame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pinhole:
    """A camera in the map."""

    camera_matrix: FloatArray  # (3, 3) [px]
    T_map_camera: FloatArray  # (4, 4)

    def __post_init__(self) -> None:
        frozen(self, "camera_matrix", np.float64, (3, 3))
        frozen(self, "T_map_camera", np.float64, (4, 4))

    def projection(self) -> FloatArray:
        """Return the matrix (3, 4) from points in the map to `depth * (x px, y px, 1)`."""
        R, t = self.T_map_camera[:3, :3], self.T_map_camera[:3, 3]
        projection: FloatArray = self.camera_matrix @ np.column_stack([R.T, -R.T @ t])
        return projection

    def pixels(self, points_map: FloatArray, shape: tuple[int, ...]) -> tuple[IntArray, BoolArray]:
        """Return the nearest pixels (N, 2) of points (N, 3), and which of them are in an image of a shape."""
        projection = self.projection()
        x, y, z = projection[:, :3] @ points_map.T + projection[:, 3:]
        is_in: BoolArray = z > 0
        near = np.stack([x, y], axis=1) / np.where(is_in, z, 1)[:, None]
        is_in &= ((near >= -0.5) & (near < np.array([shape[1], shape[0]]) - 0.5)).all(axis=1)
        return np.rint(np.where(is_in[:, None], near, 0)).astype(np.int64), is_in


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ColorView:
    """Colours, from where they were seen."""

    rgb: npt.NDArray[np.uint8]  # (H, W, 3)
    pinhole: Pinhole


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthView:
    """Depths along the view, from where they were seen, with the colours of the same moment if there are any."""

    depth_m: Float32Array  # (H, W) [m]; NaN where nothing was seen
    pinhole: Pinhole
    color: ColorView | None = None

    def __post_init__(self) -> None:
        frozen(self, "depth_m", np.float32, (None, None))

    def points(self, step_px: int = 1) -> FloatArray:
        """Return the points (N, 3) in the map of every so many pixels that saw something."""
        depth_m, rays = self.rays(step_px)
        points: FloatArray = self.pinhole.T_map_camera[:3, 3] + depth_m[:, None] * rays
        return points

    def rays(self, step_px: int) -> tuple[FloatArray, FloatArray]:
        """Return depths (N,) and rays of depth 1 (N, 3), in the map's axes, of every so many pixels that saw something."""
        first = step_px // 2
        depth_m = self.depth_m[first::step_px, first::step_px]
        rows, columns = np.nonzero(np.isfinite(depth_m))
        pixels = np.stack([columns, rows], axis=1) * step_px + first
        K = self.pinhole.camera_matrix
        rays = np.column_stack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(pixels))])
        return depth_m[rows, columns].astype(np.float64), rays @ self.pinhole.T_map_camera[:3, :3].T


class Lenses:
    """Takes distortion out of images; the way to do it is found once for each camera."""

    def __init__(self) -> None:
        self._maps: dict[tuple[object, ...], PinholeMap] = {}

    def straight(self, frame: CameraFrame) -> CameraFrame:
        """Return the image as a pinhole camera without distortion would have taken it.

        Raises:
            OperatorError: If nothing is known of the camera.
        """
        camera = require_camera(frame)
        if (camera.model, camera.distortion) == ("pinhole", "none"):
            return frame
        key = calibration_key(camera)
        if key not in self._maps:
            self._maps[key] = pinhole_map(camera, pinhole_like(camera))
        return self._maps[key].warped(frame)

    def depth_view(
        self,
        depth: CameraFrame,
        T_map_base: FloatArray,
        *,
        reach_m: tuple[float, float],
        color: ColorView | None = None,
    ) -> DepthView:
        """Return what a depth image says, at a pose (4, 4) of the base; depths out of reach are none.

        Raises:
            OperatorError: If nothing is known of the camera, or it is no depth image.
        """
        straight = self.straight(depth)
        least_m, most_m = reach_m
        return DepthView(
            depth_m=depth_m_of(straight, least_m=least_m, most_m=most_m),
            pinhole=_pinhole(straight, T_map_base),
            color=color,
        )

    def color_view(self, frame: CameraFrame, T_map_base: FloatArray) -> ColorView:
        """Return what a colour or grey image says, at a pose (4, 4) of the base.

        Raises:
            OperatorError: If nothing is known of the camera, or its images have another encoding.
        """
        straight = self.straight(frame)
        return ColorView(rgb=_rgb_of(straight), pinhole=_pinhole(straight, T_map_base))


def _pinhole(frame: CameraFrame, T_map_base: FloatArray) -> Pinhole:
    camera = require_camera(frame)
    return Pinhole(
        camera_matrix=camera.camera_matrix, T_map_camera=T_map_base @ frame.T_base_sensor.matrix
    )


def _rgb_of(frame: CameraFrame) -> npt.NDArray[np.uint8]:
    """Return the colours (H, W, 3) of an image of 8 bits."""
    require_encoding(frame, "colours", ("rgb8", "bgr8", "mono8"))
    if frame.encoding == "mono8":
        return np.repeat(frame.image[:, :, None], 3, axis=2)
    return np.ascontiguousarray(
        frame.image[:, :, ::-1] if frame.encoding == "bgr8" else frame.image
    )
