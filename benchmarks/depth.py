"""Odometry and edges from depth cameras: `python benchmarks/depth.py`.

Three seconds of W-RGBD at 10 Hz; one thread of OpenCV and one of ours. Figures are processor time, so that other work
on the machine changes them little. The other side is OpenCV's own RGB-D odometry, image to image, on the same images.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.table import Row, markdown
from mapstream.operators.decode.image import ImageDecode, ImageDecodeConfig
from mapstream.operators.depth.depth_edges import DepthEdges, DepthEdgesConfig
from mapstream.operators.odometry.dense.dense_visual_odometry import (
    DenseVisualOdometry,
    DenseVisualOdometryConfig,
)
from mapstream.recordings.worlds.orbit import orbit
from mapstream.recordings.worlds.w_rgbd import (
    START_NS,
    T_BASE_CAMERA,
    WRgbdConfig,
    rgbd_world,
)
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import invert
from mapstream.streams.messages.sensors import CameraFrame

_COUNT = 30
_Shot = tuple[CameraFrame, CameraFrame]


def _shots() -> tuple[list[_Shot], FloatArray]:
    """Return colour and depth images, and the true poses of the camera (N, 4, 4)."""
    config = WRgbdConfig()
    camera = rgbd_world(config, seed=0).camera
    stamps_ns = START_NS + (4 * 10**9 + np.arange(_COUNT) * 10**8)
    poses = orbit(config.duration_s, START_NS).poses(stamps_ns) @ T_BASE_CAMERA.matrix
    decode = ImageDecode(ImageDecodeConfig(mode="gray"))
    shots = []
    for number, (stamp_ns, T) in enumerate(zip(stamps_ns.tolist(), poses, strict=True)):
        encoded, depth = camera.take(number, stamp_ns, T)
        color = decode.decode(encoded)
        assert isinstance(color, CameraFrame)
        calibration = config.camera.calibration("color")
        shots.append((replace(color, camera=calibration), replace(depth, camera=calibration)))
    return shots, poses


def _timed(
    step: Callable[[_Shot], FloatArray], shots: list[_Shot]
) -> tuple[float, list[FloatArray]]:
    """Return how many steps one core does in a second, and what they return."""
    started = time.process_time()
    found = [step(shot) for shot in shots]
    return len(shots) / (time.process_time() - started), found


def _ours(shots: list[_Shot], width_px: int) -> tuple[float, FloatArray]:
    """Return the rate, and the motion (4, 4) of the camera from the first image to the last."""
    odometry = DenseVisualOdometry(DenseVisualOdometryConfig(width_px=width_px))

    def step(shot: _Shot) -> FloatArray:
        found = odometry.track(*shot)
        assert found is not None
        return found.T_odom_base.matrix

    rate, poses = _timed(step, shots)
    T = T_BASE_CAMERA.matrix
    return rate, np.asarray(invert(T) @ poses[-1] @ T)


def _opencv(shots: list[_Shot], width_px: int) -> tuple[float, FloatArray]:
    """Return the same of `cv2.Odometry`, whose guess is that the motion goes on."""
    camera = shots[0][0].camera
    assert camera is not None
    camera = camera.resized(width_px, width_px * 3 // 4)
    settings = cv2.OdometrySettings()
    (fx, fy), (cx, cy) = camera.focal_px, camera.center_px
    settings.setCameraMatrix(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float32))
    odometry = cv2.Odometry(cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
    size, kept = (width_px, width_px * 3 // 4), []
    T: FloatArray = np.eye(4)
    step_T: FloatArray = np.eye(4)

    def step(shot: _Shot) -> FloatArray:
        nonlocal T, step_T
        depth_m = cv2.resize(shot[1].image, size, interpolation=cv2.INTER_NEAREST) / 1000
        depth_m = np.where(depth_m > 0, depth_m, np.nan).astype(np.float32)
        image = cv2.resize(shot[0].image, size, interpolation=cv2.INTER_AREA)
        kept.append(cv2.OdometryFrame(depth_m, cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)))
        if len(kept) > 1:
            odometry.prepareFrames(kept[-1], kept[-2])
            step_T = np.asarray(odometry.compute(kept[-1], kept[-2], step_T)[1], np.float64)
            T = T @ step_T
        return T

    rate, poses = _timed(step, shots)
    return rate, poses[-1]


def run() -> list[Row]:
    """Return the measurements."""
    cv2.setNumThreads(1)
    shots, poses = _shots()
    way_m = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    true = invert(poses[0]) @ poses[-1]
    found = []
    for width_px in (640, 320):
        (ours_hz, ours), (other_hz, other) = _ours(shots, width_px), _opencv(shots, width_px)
        off = [100 * float(np.linalg.norm((T - true)[:3, 3])) / way_m for T in (ours, other)]
        size = f"{width_px} x {width_px * 3 // 4}"
        row = Row(
            what=f"dense visual odometry aligned at {size}, images of 640 x 480",
            ours=f"{ours_hz:.1f} Hz, drift {off[0]:.2f} %",
            other=f"cv2.Odometry: {other_hz:.1f} Hz, drift {off[1]:.2f} %",
            ratio=ours_hz / other_hz,
        )
        found.append(row)
    edges = DepthEdges(DepthEdgesConfig())
    alone, _ = _timed(lambda shot: edges.found(shot[1]).points.astype(np.float64), shots)
    both, _ = _timed(lambda shot: edges.found(shot[1], shot[0]).points.astype(np.float64), shots)
    found.append(
        Row(
            what="edges in space, 640 x 480",
            ours=f"{both:.1f} Hz with those of the picture",
            other=f"outlines alone: {alone:.1f} Hz",
            ratio=both / alone,
        )
    )
    return found


if __name__ == "__main__":
    print(markdown(run()))
