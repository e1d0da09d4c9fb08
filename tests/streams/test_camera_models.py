"""Every model with every distortion: there and back, derivatives, and OpenCV's opinion where it has one."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from mapstream.streams.arrays import FloatArray
from mapstream.streams.calibration import CameraCalibration, CameraModel, Distortion
from mapstream.streams.camera_models import project, projection_jacobians, unproject

# Of real lenses, some of which do not reach the image's corners.
LENSES: dict[str, tuple[Distortion, list[float]]] = {
    "none": ("none", []),
    "radtan4": ("radtan", [-0.2834, 0.0740, 0.0002, 1.8e-05]),
    "radtan5": ("radtan", [0.2624, -0.9531, -0.0054, 0.0026, 1.1633]),
    "equidistant": ("equidistant", [-0.0129, 0.0096, -0.0076, 0.0021]),
    "fov": ("fov", [0.92]),
    "rational": ("rational_polynomial", [0.5, 0.1, 5e-4, -1e-4, 0.004, 0.9, 0.25, 0.02]),
}
MODELS: list[tuple[CameraModel, float | None]] = [
    ("pinhole", None),
    ("unified", 0.0),
    ("unified", 0.8),
    ("unified", 1.6),
]
PAIRS = [
    pytest.param(model, xi, lens, id=f"{model}-{xi}-{lens}")
    for model, xi in MODELS
    for lens in LENSES
]


def camera(model: CameraModel, xi: float | None, lens: str) -> CameraCalibration:
    distortion, parameters = LENSES[lens]
    focal = 460.0 * (1 + (xi or 0.0))  # the same middle of the image for every xi
    return CameraCalibration(
        model=model,
        width_px=752,
        height_px=480,
        focal_px=np.array([focal, focal - 1.5]),
        center_px=np.array([367.2, 248.4]),
        xi=xi,
        distortion=distortion,
        distortion_parameters=np.array(parameters),
    )


def image_grid(cam: CameraCalibration) -> FloatArray:
    x, y = np.meshgrid(np.linspace(0, cam.width_px - 1, 95), np.linspace(0, cam.height_px - 1, 61))
    return np.stack([x.ravel(), y.ravel()], axis=1)


@pytest.mark.parametrize(("model", "xi", "lens"), PAIRS)
def test_A4_pixels_come_back_from_their_rays(
    model: CameraModel, xi: float | None, lens: str
) -> None:
    """Over the valid image; what is not valid is a NaN, and at the image's middle all is valid."""
    cam = camera(model, xi, lens)
    px = image_grid(cam)

    rays = unproject(cam, px)
    valid = np.isfinite(rays[:, 0])
    back, has_pixel = project(cam, 7.5 * rays[valid])

    assert has_pixel.all()
    assert np.abs(back - px[valid]).max() < 1e-6
    np.testing.assert_allclose(np.linalg.norm(rays[valid], axis=1), 1, atol=1e-12)
    inner = np.linalg.norm(px - cam.center_px, axis=1) < 250
    assert valid[inner].all()


@pytest.mark.parametrize(("model", "xi", "lens"), PAIRS)
def test_A4_points_with_a_pixel_lie_on_its_ray(
    model: CameraModel, xi: float | None, lens: str
) -> None:
    cam = camera(model, xi, lens)
    rays = np.random.default_rng(5).uniform([-1.5, -1.5, 1.0], [1.5, 1.5, 1.0], (1000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)

    px, has_pixel = project(cam, 3.0 * rays)

    px_by_ray, _ = projection_jacobians(cam, rays[has_pixel])
    misses = (unproject(cam, px[has_pixel]) - rays[has_pixel])[:, :, None]
    assert np.abs(px_by_ray @ misses).max() < 1e-6
    assert np.isnan(px[~has_pixel]).all()


def central_differences(function: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    columns = []
    for k, value in enumerate(x):
        step = np.zeros_like(x)
        step[k] = 1e-5 * max(1.0, abs(value))
        columns.append((function(x + step) - function(x - step)) / (2 * step[k]))
    return np.stack(columns, axis=-1)


def intrinsics(cam: CameraCalibration) -> FloatArray:
    xi = [] if cam.xi is None else [cam.xi]
    return np.concatenate([cam.focal_px, cam.center_px, xi, cam.distortion_parameters])


def with_intrinsics(cam: CameraCalibration, x: FloatArray) -> CameraCalibration:
    num_xi = 0 if cam.xi is None else 1
    return CameraCalibration(
        model=cam.model,
        width_px=cam.width_px,
        height_px=cam.height_px,
        focal_px=x[:2],
        center_px=x[2:4],
        xi=float(x[4]) if num_xi else None,
        distortion=cam.distortion,
        distortion_parameters=x[4 + num_xi :],
    )


@pytest.mark.parametrize(("model", "xi", "lens"), PAIRS)
def test_A4_jacobians_are_those_of_central_differences(
    model: CameraModel, xi: float | None, lens: str
) -> None:
    cam = camera(model, xi or 0.3 if model == "unified" else None, lens)
    points = np.random.default_rng(0).uniform([-0.4, -0.4, 0.8], [0.4, 0.4, 1.2], (40, 3))
    points[0] = [0, 0, 1.0]  # where radii have no direction

    by_point, by_intrinsics = projection_jacobians(cam, points)
    by_shift = central_differences(lambda t: project(cam, points + t)[0], np.zeros(3))
    by_one = central_differences(
        lambda x: project(with_intrinsics(cam, x), points)[0], intrinsics(cam)
    )

    assert np.abs(by_point - by_shift).max() < 1e-5 * np.abs(by_point).max()
    scale = np.abs(by_intrinsics).max(axis=(0, 1))
    assert (np.abs(by_intrinsics - by_one).max(axis=(0, 1)) < 1e-5 * scale).all()


@pytest.mark.parametrize("lens", ["none", "radtan4", "radtan5", "rational"])
def test_A4_pinholes_agree_with_opencv(lens: str) -> None:
    """In the pixels, and in the derivatives by the intrinsics."""
    cam = camera("pinhole", None, lens)
    points = np.random.default_rng(1).uniform([-0.5, -0.4, 0.9], [0.5, 0.4, 1.4], (50, 3))
    parameters = cam.distortion_parameters

    px, theirs = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), cam.camera_matrix, parameters if parameters.size else None
    )

    np.testing.assert_allclose(project(cam, points)[0], px[:, 0], atol=1e-9)
    _, by_intrinsics = projection_jacobians(cam, points)
    num = 4 + len(parameters)
    np.testing.assert_allclose(
        by_intrinsics.reshape(-1, num), theirs[:, 6 : 6 + num], rtol=1e-9, atol=1e-9
    )


def test_A4_equidistant_pinholes_agree_with_opencv() -> None:
    cam = camera("pinhole", None, "equidistant")
    points = np.random.default_rng(2).uniform([-2.0, -2.0, 0.5], [2.0, 2.0, 1.5], (50, 3))

    px, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), cam.camera_matrix, cam.distortion_parameters
    )

    np.testing.assert_allclose(project(cam, points)[0], px[:, 0], atol=1e-9)


@pytest.mark.parametrize("xi", [0.8, 1.6])
def test_A4_unified_radtan_agrees_with_opencv(xi: float) -> None:
    cam = camera("unified", xi, "radtan4")
    points = np.random.default_rng(3).uniform([-0.6, -0.5, 0.5], [0.6, 0.5, 1.5], (50, 3))

    px, _ = cv2.omnidir.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), cam.camera_matrix, xi, cam.distortion_parameters
    )

    np.testing.assert_allclose(project(cam, points)[0], px[:, 0], atol=1e-9)


def test_what_no_camera_sees_has_no_pixel() -> None:
    pinhole, wide = camera("pinhole", None, "none"), camera("unified", 1.6, "none")
    points = np.array([[0, 0, -1.0], [1, 0, 0], [0, 0, 0], [np.nan, 0, 1], [3, 0, -1], [0.1, 0, 1]])

    assert project(pinhole, points)[1].tolist() == [False, False, False, False, False, True]
    assert project(wide, points)[1].tolist() == [False, True, False, False, True, True]
    assert np.isnan(projection_jacobians(wide, points)[0][[0, 2, 3]]).all()
    assert np.isnan(project(wide, points)[0][[0, 2, 3]]).all()


def test_beyond_the_turn_of_a_lens_there_is_no_pixel_and_no_ray() -> None:
    """With k1 = -0.3 alone the radius grows to r = 1.054, where it is 0.703; a point farther out would come back in."""
    cam = CameraCalibration(
        width_px=640,
        height_px=480,
        focal_px=np.array([300.0, 300.0]),
        center_px=np.array([320.0, 240.0]),
        distortion="radtan",
        distortion_parameters=np.array([-0.3, 0, 0, 0]),
    )
    turn = 1 / np.sqrt(0.9)

    assert project(cam, np.array([[turn - 1e-6, 0, 1]]))[1].all()
    assert not project(cam, np.array([[turn + 1e-6, 0, 1]]))[1].any()
    edge_px = 320 + 300 * turn * (1 - 0.3 * turn**2)
    rays = unproject(cam, np.array([[edge_px - 0.01, 240.0], [edge_px + 0.01, 240.0]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1]).all()


def test_wide_lenses_see_beside_themselves() -> None:
    """The unified model has rays that point backwards, and they come back too."""
    cam = camera("unified", 0.9, "none")
    ray = np.array([[0.9, 0.1, -0.3]]) / np.linalg.norm([0.9, 0.1, -0.3])

    px, has_pixel = project(cam, 3 * ray)

    assert has_pixel.all()
    np.testing.assert_allclose(unproject(cam, px), ray, atol=1e-12)


def test_a_narrow_fov_lens_is_a_pinhole() -> None:
    pinhole = camera("pinhole", None, "none")
    points = np.array([[0.3, -0.2, 1.0], [0, 0, 1]])

    for w in (0.0, 1e-7, 5e-5, 1.1e-4):
        cam = with_intrinsics(camera("pinhole", None, "fov"), np.array([*intrinsics(pinhole), w]))
        np.testing.assert_allclose(project(cam, points)[0], project(pinhole, points)[0], atol=1e-5)
