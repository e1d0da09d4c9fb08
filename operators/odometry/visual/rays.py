"""Keypoints as measurements of directions, the same for every camera model.

A keypoint is a unit ray u and a matrix A (2, 3) that turns a change of direction into pixels, divided by the
keypoint's sigma: a point in direction d, |d| = 1, has the residual A d, of unit covariance, which is zero for
d = u. So nothing beyond this module knows of focal lengths and distortion.
"""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import blake2b

import numpy as np

from mapstream.operators.tracking.rays import rays
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import unproject
from mapstream.streams.errors import EstimationError
from mapstream.streams.messages.vision import NO_TRACK, ImageFeatures, NFrame

_STEP_PX = 2.0  # to either side, of the derivative


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Tracked keypoints of one moment, of all cameras and kinds."""

    keys: IntArray  # (N,) one number per point, over all kinds
    cameras: IntArray  # (N,) row of `mounts`
    rays: FloatArray  # (N, 3) unit, in the camera's frame
    weights: FloatArray  # (N, 2, 3) A
    distances: FloatArray  # (N,) [m] along the ray, measured by the sensor; NaN: not
    distance_sigmas: FloatArray  # (N,) [m]
    mounts: FloatArray  # (C, 4, 4) T_base_camera

    def __len__(self) -> int:
        return len(self.keys)


def rays_of(frame: NFrame, sigma_px: float) -> Rays:
    """Return what is tracked in an n-frame; keypoints without a track, or without a ray, are left out.

    Args:
        frame: Its features have cameras.
        sigma_px: Of keypoints whose features do not say.

    Raises:
        EstimationError: If features have no camera model.
    """
    parts = [_of_image(features, sigma_px) for features in frame.features]
    mounts = [features.T_base_sensor.matrix for features in frame.features]
    counts = [len(part[0]) for part in parts]
    keys, rays, weights, distances, sigmas = (
        (np.concatenate(column) for column in zip(*parts, strict=True))
        if parts
        else (np.empty(shape) for shape in ((0,), (0, 3), (0, 2, 3), (0,), (0,)))
    )
    return Rays(
        keys.astype(np.int64),
        np.repeat(np.arange(len(counts)), counts),
        rays,
        weights,
        distances,
        sigmas,
        np.array(mounts).reshape(-1, 4, 4),
    )


def _of_image(features: ImageFeatures, sigma_px: float) -> tuple[FloatArray | IntArray, ...]:
    """Return keys, rays, weights, distances and their sigmas of one image."""
    if features.camera is None:
        raise EstimationError(
            f"features of {features.frame!r} without a camera model; describe the camera in a rig"
            " file, or connect its CameraInfo topic"
        )
    px = features.keypoints_px.astype(np.float64)
    steps = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]) * _STEP_PX
    around = _unprojected(features.camera, (px + steps[:, None]).reshape(-1, 2)).reshape(5, -1, 3)
    ids = features.track_ids if features.track_ids is not None else np.full(len(px), NO_TRACK)
    kept: BoolArray = np.asarray(np.isfinite(around).all(axis=(0, 2)) & (ids != NO_TRACK))
    around = around[:, kept]
    bent = np.stack([around[1] - around[2], around[3] - around[4]], axis=2) / (2 * _STEP_PX)
    turned = np.swapaxes(bent, 1, 2)
    sigmas = np.full(len(px), sigma_px) if features.sigmas_px is None else features.sigmas_px
    weights = np.linalg.inv(turned @ bent) @ turned / sigmas[kept, None, None]
    points = np.full((len(px), 3), np.nan) if features.points_m is None else features.points_m
    distances = np.linalg.norm(points[kept].astype(np.float64), axis=1)
    known = features.point_sigmas_m
    deviations = distances * 0.02 if known is None else known[kept].astype(np.float64)
    return _keys(features.kind, ids[kept]), around[0], weights, distances, deviations


def _unprojected(camera: CameraCalibration, px: FloatArray) -> FloatArray:
    """Return unit rays (N, 3): fast inside the image, exact beyond it and where that costs nothing."""
    if camera.distortion == "none":
        return unproject(camera, px)
    size = np.array([camera.width_px, camera.height_px])
    outside = np.any((px < 0) | (px > size - 1), axis=1)
    found = rays(camera, np.where(outside[:, None], 0, px))
    found[outside] = unproject(camera, px[outside])
    return found


def _keys(kind: str, track_ids: IntArray) -> IntArray:
    """Return numbers that differ where kinds or tracks do."""
    salt = np.frombuffer(blake2b(kind.encode(), digest_size=8).digest(), np.int64)
    return np.asarray(track_ids ^ salt)
