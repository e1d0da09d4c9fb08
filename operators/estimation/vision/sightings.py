"""Residuals of what one sensor saw of points, and how they change with all that they depend on.

A keypoint's error is how far from it the point appears, a 3D point's how far from it the point is, both in units
of their standard deviations. Both come from the point in the sensor's frame, p_sensor:

    p_vertex = R_map_vertex^T (p_map - t_map_vertex)            the same for all that a vertex saw of a point
    p_moment = R_vertex_moment^T (p_vertex - t_vertex_moment)   where the base was at that very time
    p_sensor = R_base_sensor^T (p_moment - t_base_sensor)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mapstream.operators.estimation.optimize_config import Loss
from mapstream.operators.landmarks.motion import Moments
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.camera_models import project, projection_jacobians
from mapstream.streams.geometry import hat, se3_exp

Family = Literal["keypoints", "points"]


@dataclass(frozen=True, slots=True, eq=False)
class SensorState:
    """What may be refined of a sensor."""

    T_base_sensor: FloatArray  # (4, 4)
    calibration: CameraCalibration | None  # of a camera
    time_offset_s: float = 0.0  # by which images were taken later than their stamps say

    def with_intrinsics(self, parameters: FloatArray) -> SensorState:
        """Return the state with fx, fy, cx, cy, xi (if the model has it) and the distortion."""
        camera = self.calibration
        if camera is None:
            raise ValueError("a sensor that is no camera has no intrinsics")
        own = 5 if camera.xi is not None else 4
        changed = replace(
            camera,
            focal_px=parameters[:2],
            center_px=parameters[2:4],
            xi=float(parameters[4]) if camera.xi is not None else None,
            distortion_parameters=parameters[own:],
        )
        return replace(self, calibration=changed)


def intrinsics_of(camera: CameraCalibration) -> FloatArray:
    """Return fx, fy, cx, cy, xi (if the model has it) and the distortion's parameters (P,)."""
    xi = [] if camera.xi is None else [camera.xi]
    return np.concatenate(
        [camera.focal_px, camera.center_px, xi, camera.distortion_parameters]
    ).astype(np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Observations of one family by one sensor."""

    family: Family
    sensor: int  # its number in the bundle
    rows: IntArray  # (N,) of the map's observations
    pair: IntArray  # (N,) which vertex saw which point
    measured: FloatArray  # (N, 2) [px], or (N, 3) in the sensor's frame [m]
    sigmas: FloatArray  # (N,) [px] or [m]
    loss: Loss | None
    loss_width: float  # standard deviations
    gate: FloatArray  # (N,) standard deviations beyond which an observation is false
    moments: Moments | None = None  # None: all at the time of their vertex


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Errors of sightings and their derivatives, in units of standard deviations."""

    errors: FloatArray  # (N, M); NaN where the point has no pixel
    by_vertex_point: FloatArray  # (N, M, 3) by p_vertex
    by_sensor_point: FloatArray  # (N, M, 3) by p_sensor
    p_sensor: FloatArray  # (N, 3)
    by_intrinsics: FloatArray  # (N, M, P)
    by_time_offset: FloatArray  # (N, M, 1) [1/s]

    @property
    def by_mount(self) -> FloatArray:
        """Return derivatives (N, M, 6) by T_base_sensor, rotation first, on the right."""
        turned = self.by_sensor_point @ hat(self.p_sensor)
        return np.concatenate([turned, -self.by_sensor_point], axis=2)


def errors(seen: Sightings, p_vertex: FloatArray, sensor: SensorState) -> FloatArray:
    """Return errors (N, M) for points (N, 3) in the bases of their vertices."""
    p_sensor, _ = _in_sensor(seen, p_vertex, sensor)
    if seen.family == "points" or sensor.calibration is None:
        predicted = p_sensor
    else:
        predicted, _ = project(sensor.calibration, p_sensor)
    found: FloatArray = (predicted - seen.measured) / seen.sigmas[:, None]
    return found


def residuals(seen: Sightings, p_vertex: FloatArray, sensor: SensorState) -> Residuals:
    """Return errors and derivatives for points (N, 3) in the bases of their vertices."""
    p_sensor, p_moment = _in_sensor(seen, p_vertex, sensor)
    weights = 1 / seen.sigmas[:, None]
    if seen.family == "points" or sensor.calibration is None:
        predicted, by_sensor = p_sensor, np.tile(np.eye(3), (len(p_sensor), 1, 1))
        by_intrinsics = np.zeros((len(p_sensor), 3, 0))
    else:
        by_sensor, by_intrinsics = projection_jacobians(sensor.calibration, p_sensor)
        bent = by_intrinsics[
            :, [0, 1], [0, 1]
        ]  # by the focal lengths: the point on the image plane
        predicted = bent * sensor.calibration.focal_px + sensor.calibration.center_px
    by_sensor = by_sensor * weights[:, :, None]
    R_base_sensor = sensor.T_base_sensor[:3, :3]
    size = by_sensor.shape[1]
    by_moment = (by_sensor.reshape(-1, 3) @ R_base_sensor.T).reshape(-1, size, 3)
    by_vertex, by_time = by_moment, np.zeros((len(p_sensor), size, 1))
    if seen.moments is not None:
        R = _moved(seen.moments, sensor.time_offset_s)[:, :3, :3]
        by_vertex = by_moment @ np.swapaxes(R, 1, 2)
        rate, velocity = seen.moments.twists[:, :3], seen.moments.twists[:, 3:]
        drift = np.cross(p_moment, rate) - velocity
        by_time = by_moment @ drift[:, :, None]
    return Residuals(
        errors=(predicted - seen.measured) * weights,
        by_vertex_point=by_vertex,
        by_sensor_point=by_sensor,
        p_sensor=p_sensor,
        by_intrinsics=by_intrinsics * weights[:, :, None],
        by_time_offset=by_time,
    )


def chi2_and_weights(
    seen: Sightings, found: FloatArray, used: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the cost (N,), as a squared error, and the weight (N,) of each error (N, M) under the loss.

    What takes part but has no pixel here, as behind the camera, costs as much as at the gate and pulls nowhere.
    """
    squared = (found * found).sum(axis=1)
    is_seen = np.isfinite(squared)
    squared = np.where(is_seen, squared, seen.gate**2)
    cost, weights = _under_loss(seen, squared)
    return np.where(used, cost, 0.0), np.where(used & is_seen, weights, 0.0)


def _under_loss(seen: Sightings, squared: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the loss, whose slope at zero is one, and its derivative by the squared error."""
    c2 = seen.loss_width**2
    if seen.loss == "huber":
        length = np.sqrt(np.maximum(squared, c2))
        return np.where(squared <= c2, squared, 2 * seen.loss_width * length - c2), seen.loss_width / length  # fmt: skip
    if seen.loss == "cauchy":
        return c2 * np.log1p(squared / c2), 1 / (1 + squared / c2)
    if seen.loss == "geman_mcclure":
        return c2 * squared / (c2 + squared), (c2 / (c2 + squared)) ** 2
    if seen.loss == "tukey":
        left = np.clip(1 - squared / c2, 0, 1)
        return c2 / 3 * (1 - left**3), left**2
    return squared, np.ones_like(squared)


def _in_sensor(
    seen: Sightings, p_vertex: FloatArray, sensor: SensorState
) -> tuple[FloatArray, FloatArray]:
    """Return the points (N, 3) in the frame of the sensor, and in that of the base at their times."""
    p_moment = p_vertex
    if seen.moments is not None:
        T = _moved(seen.moments, sensor.time_offset_s)
        p_moment = np.einsum("nji,nj->ni", T[:, :3, :3], p_vertex - T[:, :3, 3])
    R, t = sensor.T_base_sensor[:3, :3], sensor.T_base_sensor[:3, 3]
    return (p_moment - t) @ R, p_moment


def _moved(moments: Moments, late_s: float) -> FloatArray:
    """Return T_vertex_moment (N, 4, 4) some time later."""
    if late_s == 0:
        return moments.T_vertex_moment
    moved: FloatArray = moments.T_vertex_moment @ se3_exp(late_s * moments.twists)
    return moved
