"""Tiny data sets of cameras, in the layouts of the public ones."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

GRAY = np.arange(48, dtype=np.uint8).reshape(6, 8)
_KINECT = np.full((480, 640), 90, np.uint8)
DEPTH = np.array([[0, 5000, 65535], [10000, 1, 2500]], np.uint16)

EUROC_CAMERA = """%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0.3, 0, 0, 0, 1]
resolution: [8, 6]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375]
distortion_model: radial-tangential
distortion_coefficients: [-0.28, 0.07, 0.0002, 1.7e-05]
"""
EUROC_IMU = """sensor_type: imu
T_BS: {cols: 4, rows: 4, data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
gyroscope_noise_density: 1.6968e-04
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0000e-3
accelerometer_random_walk: 3.0000e-3
"""


def euroc(folder: Path) -> Path:
    """Write two cameras, an IMU and truth in the ASL layout."""
    texts = {
        "imu0/data.csv": "#timestamp [ns],w_RS_S_x\n1403715273262142976,1,2,3,4,5,6\n",
        "imu0/sensor.yaml": EUROC_IMU,
        "state_groundtruth_estimate0/data.csv": "#t\n1403715273262142976,1,2,3,1,0,0,0\n",
    }
    for name in ("cam0", "cam1"):
        listing = "#timestamp [ns],filename\n1403715273262142976,a.png\n"
        texts |= {f"{name}/data.csv": listing, f"{name}/sensor.yaml": EUROC_CAMERA}
        (folder / "mav0" / name / "data").mkdir(parents=True)
        cv2.imwrite(str(folder / "mav0" / name / "data" / "a.png"), GRAY)
    for name, content in texts.items():
        path = folder / "mav0" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return folder


def kitti(folder: Path) -> Path:
    """Write two stereo pairs with calibration and poses; `Tr` is there, scans are not."""
    for name in ("image_0", "image_1"):
        (folder / name).mkdir(parents=True)
        for index in range(2):
            cv2.imwrite(str(folder / name / f"{index:06d}.png"), GRAY + index)
    (folder / "calib.txt").write_text(
        "P0: 700 0 4 0 0 700 3 0 0 0 1 0\nP1: 700 0 4 -350 0 700 3 0 0 0 1 0\n"
        "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 -0.3\n"
    )
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 2\n")
    return folder


def tum(folder: Path) -> Path:
    """Write one image, one depth and one pose; the name of the folder tells the camera."""
    folder = folder / "rgbd_dataset_freiburg1_tiny"
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    cv2.imwrite(str(folder / "rgb" / "a.png"), _KINECT)
    cv2.imwrite(str(folder / "depth" / "a.png"), DEPTH)
    (folder / "rgb.txt").write_text("# color images\n1305031102.175304 rgb/a.png\n")
    (folder / "depth.txt").write_text("# depth maps\n1305031102.160407 depth/a.png\n")
    (folder / "groundtruth.txt").write_text("# t\n1305031102.1600 1 2 3 0 0 0 1\n")
    return folder


def seven_scenes(folder: Path) -> Path:
    """Write two frames, the second of which has lost its pose."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(2):
        cv2.imwrite(str(folder / f"frame-{index:06d}.color.png"), _KINECT)
        cv2.imwrite(str(folder / f"frame-{index:06d}.depth.png"), DEPTH)
    (folder / "frame-000000.pose.txt").write_text("1 0 0 1\n0 1 0 2\n0 0 1 3\n0 0 0 1\n")
    (folder / "frame-000001.pose.txt").write_text("\t".join(["NaN"] * 16))
    return folder
