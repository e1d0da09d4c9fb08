"""Odometry from planes and edges: a bare box on a bare floor, and a real one."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from mapstream.operators.odometry.rgbd.rgbd_odometry import RgbdOdometry, RgbdOdometryConfig
from mapstream.recordings.evaluation import ape
from mapstream.recordings.pose_pairs import PosePairs
from mapstream.streams.arrays import Float32Array, FloatArray
from mapstream.streams.calibration import CameraCalibration
from mapstream.streams.errors import OperatorError
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import CameraFrame
from tests.data import shared


def calibration(
    size_px: tuple[int, int], focal_px: list[float], center_px: list[float]
) -> CameraCalibration:
    return CameraCalibration(
        width_px=size_px[0],
        height_px=size_px[1],
        focal_px=np.array(focal_px),
        center_px=np.array(center_px),
        distortion_parameters=np.empty(0),
    )


CAMERA = calibration((320, 240), [262.0, 262.0], [160.0, 120.0])
T_BASE_CAMERA = SE3.from_rotation(so3_exp([0.1, -0.2, 0.3]), [0.1, 0.05, -0.02])
HALF_M = np.array([0.2, 0.3, 0.28])  # of the box; it stands on the floor


def look(at_rad: float, distance_m: float = 1.5, height_m: float = 1.1) -> FloatArray:
    """Return the pose (4, 4) of a camera beside the box, which it looks at."""
    place = np.array([distance_m * np.cos(at_rad), distance_m * np.sin(at_rad), height_m])
    z = np.array([0, 0, 0.25]) - place
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), place
    return T


def seen(T: FloatArray) -> tuple[np.ndarray, Float32Array]:
    """Return the gray image and the depth [m] of the box and the floor; each face has one shade."""
    u, v = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    rays = np.dstack([(u - 160) / 262, (v - 120) / 262, np.ones_like(u)])
    way, start = rays @ T[:3, :3].T, T[:3, 3]
    middle = np.array([0, 0, HALF_M[2]])
    with np.errstate(divide="ignore", invalid="ignore"):
        slabs = np.stack([(middle + s * HALF_M - start) / way for s in (-1, 1)])
        floor = np.where(way[..., 2] < 0, -start[2] / way[..., 2], np.nan)
    into, out = slabs.min(axis=0), slabs.max(axis=0).min(axis=-1)
    enters = into.max(axis=-1)
    is_box = (enters < out) & (enters > 0)
    shade = np.array([60, 90, 130])[into.argmax(axis=-1)]
    depth = np.where(is_box, enters, floor)
    return np.where(is_box, shade, 220).astype(np.uint8), depth.astype(np.float32)


def images(stamp_ns: int, T: FloatArray, seed: int = 0) -> tuple[CameraFrame, CameraFrame]:
    """Return an image and its depth, with the noise of structured light."""
    shades, depth = seen(T)
    noise = np.random.default_rng(seed).normal(0, 0.002, depth.shape) * depth**2
    common: dict[str, Any] = {
        "stamp_ns": stamp_ns,
        "T_base_sensor": T_BASE_CAMERA,
        "camera": CAMERA,
    }
    noisy = (depth + noise).astype(np.float32)
    return (
        CameraFrame(image=shades, encoding="mono8", **common),
        CameraFrame(image=noisy, encoding="32FC1", **common),
    )


def tracked(odometry: RgbdOdometry, poses: list[FloatArray]) -> list[Odometry]:
    found = [odometry.track(*images((k + 1) * 10**9, T, k)) for k, T in enumerate(poses)]
    return [each for each in found if each is not None]


def base_steps(poses: list[FloatArray]) -> list[SE3]:
    """Return where the base truly was, from where it first was."""
    bases = [SE3(T) @ T_BASE_CAMERA.inverse() for T in poses]
    return [bases[0].inverse() @ base for base in bases]


@pytest.mark.slow
def test_a_bare_box_is_followed_at_a_low_rate_from_corner_to_face() -> None:
    """Facing one side, planes leave the way along it open: by them alone the end is 0.6 m off."""
    poses = [look(angle, 1.5 + 0.02 * k) for k, angle in enumerate(np.arange(0.6, -0.3, -0.12))]

    found = tracked(RgbdOdometry(RgbdOdometryConfig()), poses)

    assert not any(each.is_lost for each in found)
    for each, true in zip(found, base_steps(poses), strict=True):
        wrong = true.inverse() @ each.T_odom_base
        assert np.linalg.norm(wrong.t) < 0.03
        assert wrong.angle_rad < 0.02


def test_a_view_that_fits_nothing_is_lost_and_says_so() -> None:
    odometry = RgbdOdometry(RgbdOdometryConfig())
    (first, _), (again, _) = images(1, look(0.6)), images(2, look(0.6))
    nothing = CameraFrame(
        stamp_ns=2, image=np.full((240, 320), np.nan, np.float32), encoding="32FC1", camera=CAMERA
    )
    start = odometry.track(first, images(1, look(0.6))[1])

    lost = odometry.track(again, nothing)

    assert start is not None
    assert lost is not None
    assert (start.is_lost, lost.is_lost) == (False, True)
    np.testing.assert_allclose(lost.T_odom_base.matrix, np.eye(4), atol=1e-9)


def test_depth_of_another_size_is_refused() -> None:
    frame, depth = images(1, look(0.6))
    small = CameraFrame(stamp_ns=1, image=depth.image[:100], encoding="32FC1")

    with pytest.raises(OperatorError, match="depth_registration"):
        RgbdOdometry(RgbdOdometryConfig()).track(frame, small)


@pytest.mark.slow
def test_a_real_cabinet_without_texture() -> None:
    """The way from its long side to its short one, 12 images at 1.5 Hz; the whole way has 58."""
    folder = shared("tum_fr3_cabinet_rgbd")
    truth = np.loadtxt(folder / "truth_cam_poses.txt")[:12]
    camera = calibration((640, 480), [535.4, 539.2], [320.1, 247.6])
    odometry = RgbdOdometry(RgbdOdometryConfig())
    stamps_ns = np.round(truth[:, 0] * 1e9).astype(np.int64)
    found = []
    for k, stamp_ns in enumerate(stamps_ns):
        color = cv2.imread(str(folder / f"raw_imgs/{k:04d}_rgb_raw.jpg"))
        depth = cv2.imread(str(folder / f"depth_imgs/{k:04d}_depth_raw.png"), cv2.IMREAD_UNCHANGED)
        assert color is not None
        assert depth is not None
        common: dict[str, Any] = {"stamp_ns": int(stamp_ns), "camera": camera}
        each = odometry.track(
            CameraFrame(image=color, encoding="bgr8", **common),
            CameraFrame(image=(depth / np.float32(5000)), encoding="32FC1", **common),
        )
        assert each is not None
        assert not each.is_lost
        found.append(each.T_odom_base.matrix)

    reference = np.array([SE3.from_quat_xyzw(row[4:], row[1:4]).matrix for row in truth])
    pairs = PosePairs(stamps_ns=stamps_ns, estimate=np.array(found), reference=reference)
    assert ape(pairs).translation.rmse < 0.05
