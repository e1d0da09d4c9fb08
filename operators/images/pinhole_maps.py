"""Images as a pinhole camera without distortion would have taken them from the same place."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from mapstream.operators.images.frame_filter import DEPTHS
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project, projection_jacobians
from mapstream.streams.geometry import SE3
from mapstream.streams.messages.sensors import CameraFrame

_OUTSIDE = -1e6  # [px] of no image


@dataclass(frozen=True, slots=True, eq=False)
class PinholeMap:
    """Where each pixel of the new camera is in the image of the old one."""

    camera: CameraCalibration  # the new one
    R_old_new: FloatArray  # (3, 3)
    x: Float32Array  # (H, W) [px]
    y: Float32Array  # (H, W) [px]

    def warped(self, frame: CameraFrame) -> CameraFrame:
        """Return what the new camera sees; black, or no depth, where the old one saw nothing."""
        method = cv2.INTER_NEAREST if frame.encoding in DEPTHS else cv2.INTER_LINEAR
        image = np.asarray(cv2.remap(frame.image, self.x, self.y, method))
        T_old_new = SE3.from_rotation(self.R_old_new)
        return replace(
            frame,
            image=image,
            camera=self.camera,
            T_base_sensor=frame.T_base_sensor @ T_old_new,
            record=None,  # what lies there is seen through the old lens
        )


def pinhole_map(
    old: CameraCalibration, new: CameraCalibration, R_old_new: FloatArray | None = None
) -> PinholeMap:
    """Return the map from an old camera to a new one that may be turned (3, 3) against it."""
    R_old_new = np.eye(3) if R_old_new is None else R_old_new
    x, y = np.meshgrid(np.arange(new.width_px), np.arange(new.height_px))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    rays = np.column_stack([(pixels - new.center_px) / new.focal_px, np.ones(len(pixels))])
    px, is_seen = project(old, rays @ R_old_new.T)
    px = np.where(is_seen[:, None], px, _OUTSIDE).reshape(new.height_px, new.width_px, 2)
    x_px, y_px = (px[:, :, axis].astype(np.float32) for axis in range(2))
    return PinholeMap(new, R_old_new, x_px, y_px)


def pinhole_like(camera: CameraCalibration, zoom: float = 1.0) -> CameraCalibration:
    """Return a pinhole camera without distortion that sees the middle of the image as large as `camera` does.

    Args:
        camera: Of any model.
        zoom: Of the focal length; less shows more of what lies near the border.
    """
    by_point, _ = projection_jacobians(camera, np.array([[0.0, 0.0, 1.0]]))
    return replace(
        camera,
        model="pinhole",
        xi=None,
        focal_px=zoom * np.diagonal(by_point[0][:, :2]),
        distortion="none",
        distortion_parameters=np.empty(0),
    )


def calibration_key(camera: CameraCalibration) -> tuple[object, ...]:
    """Return what tells calibrations apart: equal ones need one map, whoever sent them."""
    arrays = (camera.focal_px, camera.center_px, camera.distortion_parameters)
    size = (camera.width_px, camera.height_px)
    return (camera.model, camera.xi, camera.distortion, size, *(a.tobytes() for a in arrays))
