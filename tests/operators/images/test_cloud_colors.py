"""Points get the colour of the pixel that shows them."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.operators.images.cloud_colors import CloudColors, CloudColorsConfig
from mapstream.operators.testing import run_operator
from mapstream.streams.arrays import Float32Array
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.estimates import Odometry, PointCloud
from mapstream.streams.messages.sensors import CameraFrame
from tests.operators.images.cameras import camera, frame

pytestmark = pytest.mark.anyio
_FORWARD = SE3.from_rotation(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), [0.1, 0.0, 0.0])
_CAMERA = camera(frame="camera")


def _painted(at_m: Float32Array) -> Float32Array:
    """Return the colours (N, 3) of places on the wall x = 4 m, smooth."""
    y, z = at_m[:, 1], at_m[:, 2]
    return np.stack([128 + 100 * np.sin(y), 128 + 100 * np.cos(z), 60 + 20 * y], axis=1)


def _wall(step_m: float = 0.02) -> Float32Array:
    y, z = np.meshgrid(np.arange(-2, 2, step_m), np.arange(-1, 1, step_m))
    return np.stack([np.full(y.size, 4.0), y.ravel(), z.ravel()], axis=1).astype(np.float32)


def _seen(T_odom_base: SE3, stamp_ns: int = 0) -> CameraFrame:
    """Return the image of the wall, which stands at x = 4 m of the odometry's frame."""
    place = T_odom_base @ _FORWARD
    x, y = np.meshgrid(np.arange(_CAMERA.width_px), np.arange(_CAMERA.height_px))
    rays = np.stack([(x - _CAMERA.center_px[0]) / _CAMERA.focal_px[0],
                     (y - _CAMERA.center_px[1]) / _CAMERA.focal_px[1], np.ones(x.shape)], axis=-1)  # fmt: skip
    rays = rays.reshape(-1, 3) @ place.R.T
    at = place.t + rays * ((4.0 - place.t[0]) / rays[:, :1])
    image = _painted(at).reshape(*x.shape, 3)[..., ::-1]
    return frame(np.round(image).clip(0, 255).astype(np.uint8), "bgr8", _CAMERA, _FORWARD, stamp_ns)


def _psnr(cloud: PointCloud, T_odom_base: SE3) -> tuple[float, int]:
    """Return how well the colours of a cloud fit the paint [dB], and how many there are."""
    assert cloud.colors_rgba is not None
    has = cloud.colors_rgba[:, 3] > 0
    at = cloud.points[has] @ T_odom_base.R.T + T_odom_base.t
    error = cloud.colors_rgba[has, :3].astype(float) - _painted(at.astype(np.float32))
    return float(20 * np.log10(255 / np.sqrt(np.mean(error**2)))), int(has.sum())


async def test_O9_points_have_the_colour_of_the_wall() -> None:
    out = await run_operator(
        CloudColors(CloudColorsConfig()),
        clouds=[PointCloud(stamp_ns=0, points=_wall())],
        frames=[_seen(SE3.identity())],
    )

    psnr, count = _psnr(out["clouds"][0], SE3.identity())
    assert psnr > 35
    assert count > 5000


async def test_O9_motion_between_image_and_cloud_is_undone() -> None:
    """The robot turns and drives; the image is 50 ms older than the cloud."""
    moved = SE3.from_rotation(so3_exp([0.0, 0.0, 0.1]), [0.3, 0.1, 0.0])
    stamps_ns = (-60_000_000, 0, 60_000_000)
    poses = [
        Odometry(stamp_ns=s, T_odom_base=moved if s == 0 else SE3.identity()) for s in stamps_ns
    ]
    there = moved.inverse()
    cloud = PointCloud(stamp_ns=0, points=(_wall() @ there.R.T + there.t).astype(np.float32))
    seen = [_seen(SE3.identity(), -60_000_000)]
    operator = CloudColors(CloudColorsConfig())

    still = await run_operator(operator, clouds=[cloud], frames=seen)
    with_motion = await run_operator(operator, clouds=[cloud], frames=seen, odometry=poses)

    assert _psnr(with_motion["clouds"][0], moved)[0] > 35
    assert _psnr(still["clouds"][0], moved)[0] < 25


async def test_O9_what_is_hidden_gets_no_colour() -> None:
    y, z = np.meshgrid(np.arange(-0.3, 0.3, 0.02), np.arange(-0.3, 0.3, 0.02))
    post = np.stack([np.full(y.size, 2.0), y.ravel(), z.ravel()], axis=1).astype(np.float32)
    cloud = PointCloud(stamp_ns=0, points=np.concatenate([post, _wall()]))

    out = await run_operator(
        CloudColors(CloudColorsConfig()), clouds=[cloud], frames=[_seen(SE3.identity())]
    )

    colors = out["clouds"][0].colors_rgba
    assert colors is not None
    in_shadow = (np.abs(cloud.points[:, 1:]) < 0.5).all(axis=1)  # of the post, on the wall
    behind = in_shadow & (cloud.points[:, 0] > 3)
    assert behind.sum() > 2000
    assert not colors[behind, 3].any()
    assert colors[: len(post), 3].all()


async def test_a_second_camera_fills_what_the_first_left() -> None:
    known = np.zeros((len(_wall()), 4), np.uint8)
    known[0] = [1, 2, 3, 255]
    cloud = PointCloud(stamp_ns=0, points=_wall(), colors_rgba=known)

    colored = CloudColors(CloudColorsConfig()).colored(cloud, _seen(SE3.identity()))

    assert colored.colors_rgba is not None
    assert colored.colors_rgba[0].tolist() == [1, 2, 3, 255]
    assert colored.colors_rgba[:, 3].sum() > known[:, 3].sum()


async def test_a_cloud_without_an_image_goes_on() -> None:
    cloud = PointCloud(stamp_ns=0, points=_wall(0.5))
    out = await run_operator(CloudColors(CloudColorsConfig()), clouds=[cloud], frames=[])
    assert out["clouds"][0].colors_rgba is None
