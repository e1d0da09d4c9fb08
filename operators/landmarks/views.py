"""What observations say in the map frame: rays through keypoints, and 3D points.

Rows of a rolling shutter are taken one after another: the keypoint's own row says when.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mapstream.operators.landmarks.motion import Motion, moments
from mapstream.operators.landmarks.sensors import T_base_sensor_of, all_cameras, sensors_of
from mapstream.recordings.maps.cameras import Camera
from mapstream.recordings.maps.model import Map
from mapstream.streams.arrays import BoolArray, FloatArray, IntArray
from mapstream.streams.camera_models import project, unproject

POINT_SIGMA_M = 0.05
"""Of 3D points whose sensor says nothing: between a LiDAR's and a depth camera's."""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Observations from where their sensors were at their times."""

    rows: IntArray  # (N,) of observations
    T_map_sensor: FloatArray  # (N, 4, 4)
    rays: FloatArray  # (N, 3) unit, in the map frame; NaN without a keypoint or a camera
    ray_sigmas_rad: FloatArray  # (N,)
    points: FloatArray  # (N, 3) in the map frame [m]; NaN where only a ray is known
    point_sigmas_m: FloatArray  # (N,)

    def taken(self, which: BoolArray | IntArray) -> Views:
        """Return some of these, by a mask or by their numbers."""
        return Views(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


def views_of(map_: Map, rows: IntArray) -> Views:
    """Return what these observations say in the map frame."""
    seen = map_.observations
    T_map_sensor = T_map_sensor_of(map_, rows)
    rays, sigmas_rad = np.full((len(rows), 3), np.nan), np.full(len(rows), np.nan)
    for camera, own in by_camera(map_, rows):
        px = seen.keypoint_px[rows[own]].astype(np.float64)
        rays[own] = unproject(camera.calibration, px)
        sigmas_rad[own] = seen.sigma[rows[own]] / camera.calibration.focal_px.mean()
    p_sensor = seen.p_sensor[rows].astype(np.float64)
    return Views(
        rows=rows,
        T_map_sensor=T_map_sensor,
        rays=np.einsum("nij,nj->ni", T_map_sensor[:, :3, :3], rays),
        ray_sigmas_rad=sigmas_rad,
        points=np.einsum("nij,nj->ni", T_map_sensor[:, :3, :3], p_sensor) + T_map_sensor[:, :3, 3],
        point_sigmas_m=point_sigmas_m(map_, rows),
    )


def point_sigmas_m(map_: Map, rows: IntArray) -> FloatArray:
    """Return the standard deviations (N,) of the 3D points of observations."""
    seen = map_.observations
    has_pixel = np.isfinite(seen.keypoint_px[rows]).all(axis=1)
    sigmas = np.where(has_pixel, seen.sigma_m[rows], seen.sigma[rows]).astype(np.float64)
    return np.where(sigmas > 0, sigmas, POINT_SIGMA_M)


def T_map_sensor_of(map_: Map, rows: IntArray) -> FloatArray:
    """Return where the sensors of observations were when they made them (N, 4, 4)."""
    vertices = map_.observations.vertex[rows]
    T_map_base = map_.T_map_base(vertices)
    offsets_ns = capture_offsets_ns(map_, rows)
    if offsets_ns.any():
        T_map_base = T_map_base @ moments(Motion.of(map_), vertices, offsets_ns).T_vertex_moment
    poses: FloatArray = T_map_base @ T_base_sensor_of(map_, rows)
    return poses


def capture_offsets_ns(map_: Map, rows: IntArray) -> IntArray:
    """Return when observations (N,) were made after their vertices [ns], row by row of rolling shutters."""
    offsets_ns = map_.observations.offset_ns[rows].copy()
    for camera, own in by_camera(map_, rows):
        if camera.calibration.line_delay_ns:
            image_row = map_.observations.keypoint_px[rows[own], 1].astype(np.float64)
            delay_ns = np.rint(image_row * camera.calibration.line_delay_ns)
            offsets_ns[own] += delay_ns.astype(np.int64)
    return offsets_ns


def by_camera(map_: Map, rows: IntArray) -> Iterator[tuple[Camera, IntArray]]:
    """Yield each camera and which of the observations (N,) are keypoints in its images."""
    sensors, at = sensors_of(map_, rows)
    cameras = all_cameras(map_)
    has_pixel = np.isfinite(map_.observations.keypoint_px[rows]).all(axis=1)
    for number, sensor in enumerate(sensors):
        if sensor in cameras:
            yield cameras[sensor], np.flatnonzero((at == number) & has_pixel)


def reprojection_errors_px(map_: Map, rows: IntArray) -> FloatArray:
    """Return how far (N,) from its keypoint each observation's landmark appears [px].

    It is infinite where the landmark has no pixel, as behind the camera, and NaN where there is no keypoint.
    """
    seen = map_.observations
    T = T_map_sensor_of(map_, rows)
    p_map = map_.T_map_landmark(seen.landmark[rows])[:, :3, 3]
    p_sensor = np.einsum("nji,nj->ni", T[:, :3, :3], p_map - T[:, :3, 3])
    errors_px = np.full(len(rows), np.nan)
    for camera, own in by_camera(map_, rows):
        px, is_seen = project(camera.calibration, p_sensor[own])
        away = np.linalg.norm(px - seen.keypoint_px[rows[own]], axis=1)
        errors_px[own] = np.where(is_seen, away, np.inf)
    return errors_px
