"""Planes in depth images of W-RGBD: `python benchmarks/planes.py`.

Ten images of 640 x 480 px, one thread of OpenCV and one of ours; figures are processor time. The other side is
OpenCV's own normals of the same images (FALS and the method of LINEMOD), which are but the first step of a segmentation. Rows
with an angle compare normals of pixels well within planes with the true ones.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.operators.planes.plane_segmentation import (
    PlaneSegmentation,
    PlaneSegmentationConfig,
)
from mapstream.recordings.worlds.orbit import orbit
from mapstream.recordings.worlds.w_rgbd import START_NS, T_BASE_CAMERA, WRgbdConfig, rgbd_world
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.messages.sensors import CameraFrame

_NUM = 10
_WITHIN_PX = 11  # of one surface around a pixel whose normal is compared
_METHODS = {"FALS": cv2.RgbdNormals_RGBD_NORMALS_METHOD_FALS, "LINEMOD": cv2.RgbdNormals_RGBD_NORMALS_METHOD_LINEMOD}  # fmt: skip


@dataclass(frozen=True)
class Shot:
    """A depth image and what is true of it."""

    depth: CameraFrame
    surfaces: IntArray  # (H, W)
    normals: FloatArray  # (H, W, 3) in the camera's frame


def _shots() -> list[Shot]:
    config = WRgbdConfig(texel_m=0.05)
    world, motion = rgbd_world(config, 0), orbit(40.0, START_NS)
    true = np.array([surface.normal for surface in world.room.surfaces])
    shots = []
    for number in range(0, 40 * _NUM, 40):
        stamp_ns = START_NS + number * 10**8
        T = motion.poses(np.array([stamp_ns]))[0] @ T_BASE_CAMERA.matrix
        _, depth = world.camera.take(number, stamp_ns, T)
        surfaces = world.camera.ideal(T).surfaces
        camera = config.camera.calibration("depth")
        shots.append(Shot(replace(depth, camera=camera), surfaces, true[surfaces] @ T[:3, :3]))
    return shots


def _seconds(step: Callable[[Shot], object], shots: list[Shot]) -> float:
    step(shots[0])
    started = time.process_time()
    for shot in shots:
        step(shot)
    return (time.process_time() - started) / len(shots)


def _points(depth: CameraFrame) -> FloatArray:
    K = WRgbdConfig().camera.calibration("depth").camera_matrix
    points = cv2.depthTo3d(depth.image, K)
    return np.asarray(points, dtype=np.float32)


def _angle_deg(shot: Shot, normals: FloatArray) -> FloatArray:
    """Return errors of normals well within surfaces that have a depth; NaN counts as a right angle."""
    kernel = np.ones((_WITHIN_PX, _WITHIN_PX), np.uint8)
    surfaces = shot.surfaces.astype(np.float32)
    inside = (cv2.erode(surfaces, kernel) == cv2.dilate(surfaces, kernel)) & (shot.depth.image > 0)
    cosine = np.abs(np.einsum("ij,ij->i", normals[inside], shot.normals[inside]))
    angles: FloatArray = np.rad2deg(np.arccos(np.clip(np.nan_to_num(cosine), 0, 1)))
    return angles


def _of_planes(operator: PlaneSegmentation, shot: Shot) -> FloatArray:
    planes, labels = operator.segment(shot.depth)
    T_camera_base = np.linalg.inv(shot.depth.T_base_sensor.matrix)
    in_camera = np.concatenate(
        [np.full((1, 3), np.nan), planes.T_base_plane[:, :3, 2] @ T_camera_base[:3, :3].T]
    )
    normals: FloatArray = in_camera[labels.image]
    return np.where(
        np.isfinite(normals), normals, shot.normals
    )  # where there is no plane, no error


def run() -> list[Row]:
    """Return segmentation against OpenCV's normals of the same images."""
    cv2.setNumThreads(1)
    shots, operator = _shots(), PlaneSegmentation(PlaneSegmentationConfig())
    ours_s = _seconds(lambda shot: operator.segment(shot.depth), shots)
    ours_deg = np.concatenate([_angle_deg(shot, _of_planes(operator, shot)) for shot in shots])
    K = WRgbdConfig().camera.calibration("depth").camera_matrix
    rows = []
    for name, method in _METHODS.items():
        normals = cv2.RgbdNormals.create(480, 640, cv2.CV_32F, K, 7, 50, method)
        other_s = _seconds(lambda shot, n=normals: n.apply(_points(shot.depth)), shots)  # type: ignore[misc]  # bound now
        other_deg = np.concatenate(
            [
                _angle_deg(
                    shot, np.asarray(normals.apply(_points(shot.depth)), np.float64)[..., :3]
                )
                for shot in shots
            ]
        )
        rows += [
            Row(
                what="plane segmentation, 640 x 480",
                ours=f"{1 / ours_s:.1f} Hz",
                other=f"normals alone ({name}): {1 / other_s:.1f} Hz",
                ratio=ours_s / other_s,
                bar="at least 10 Hz",
            ),
            Row(
                what="normals within planes, mean error",
                ours=f"{ours_deg.mean():.3f} deg",
                other=f"{name}, window of 7 px: {other_deg.mean():.2f} deg",
                ratio=float(ours_deg.mean() / other_deg.mean()),
            ),
        ]
    return rows


if __name__ == "__main__":
    print(markdown(run()))
