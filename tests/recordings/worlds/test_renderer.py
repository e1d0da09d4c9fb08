"""Drawn images against geometry: what is where in the picture, how deep, and what hides what."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.recordings.worlds.lens import Lens
from mapstream.recordings.worlds.paint import Picture
from mapstream.recordings.worlds.renderer import Pinhole, Renderer, occluding_edges
from mapstream.recordings.worlds.surfaces import Surface, box_outline, prism, rectangle
from mapstream.recordings.worlds.vi_rig import LensName, ViCameraConfig
from mapstream.streams.arrays import FloatArray
from mapstream.streams.camera_models import project
from mapstream.streams.geometry import SE3, invert, se3_exp

TEXEL_M = 0.01
SPOT_M = 0.04  # standard deviation
WALL_M = (6.0, 4.0)
CAMERA = Pinhole((300.0, 310.0), (160.5, 118.0), (320, 240))
AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def spots() -> FloatArray:
    """Return places (N, 2) on the wall, a metre apart."""
    s, t = np.meshgrid(np.arange(0.5, WALL_M[0]), np.arange(0.5, WALL_M[1]))
    return np.stack([s.ravel(), t.ravel()], axis=1)


def spotted(size_m: tuple[float, float]) -> Picture:
    s = (np.arange(round(size_m[0] / TEXEL_M)) + 0.5) * TEXEL_M
    t = (np.arange(round(size_m[1] / TEXEL_M)) + 0.5) * TEXEL_M
    picture = np.zeros((len(t), len(s)))
    for at_s, at_t in spots():
        bump = np.exp(-(((s - at_s) ** 2) + ((t - at_t) ** 2)[:, None]) / 2 / SPOT_M**2)
        picture += 250 * bump
    return np.clip(picture, 0, 255).astype(np.uint8)


def wall() -> Surface:
    """Return a wall three metres ahead of the origin, across x."""
    return rectangle(
        "wall", [3, 3, 2], [0, -WALL_M[0], 0], [0, 0, -WALL_M[1]], spotted, is_shell=True
    )


def grey(level: int) -> Picture:
    return np.full((8, 8), level, np.uint8)


def brightest(image: Picture, px: FloatArray) -> FloatArray:
    """Return the centre of light (2,) near a pixel."""
    x, y = np.rint(px).astype(int)
    window = image[y - 7 : y + 8, x - 7 : x + 8].astype(float)
    window -= window.min()
    dx, dy = np.meshgrid(np.arange(-7, 8), np.arange(-7, 8))
    total = window.sum()
    return np.array([x + (window * dx).sum() / total, y + (window * dy).sum() / total])


LENSES: list[LensName] = ["none", "radtan", "rational", "equidistant", "fov", "unified"]


@pytest.mark.parametrize("lens", LENSES)
def test_points_are_drawn_where_they_project(lens: LensName) -> None:
    """Spots on a wall, seen aslant, lie within 0.1 px of their projection: lens, tiles and levels of detail."""
    camera = ViCameraConfig(width_px=320, height_px=240, lens=lens).calibration("left")
    T_world_camera = AHEAD @ se3_exp([0.1, 0.15, -0.2, 0.2, -0.3, -0.4])

    image = Lens(Renderer([wall()]), camera).image(T_world_camera[None])

    points = (
        wall().points(spots()) @ invert(T_world_camera)[:3, :3].T + invert(T_world_camera)[:3, 3]
    )
    px, seen = project(camera, points)
    inside = seen & (px > 10).all(axis=1) & (px < [309, 229]).all(axis=1)
    errors = [brightest(image, at) - at for at in px[inside]]
    assert inside.sum() >= 6
    assert np.abs(errors).max() < 0.1


def test_a_rolling_shutter_is_drawn_row_by_row() -> None:
    """Each band from its own pose: spots lie where they project at the time of their row."""
    config = ViCameraConfig(width_px=320, height_px=240, lens="radtan", readout_s=0.02)
    camera = config.calibration("left")
    lens = Lens(Renderer([wall()]), camera)
    twist = np.array([0.1, 1.0, 0.2, 0.3, 0.1, 0.2])  # [rad/s], [m/s]

    def at_rows(rows: FloatArray, points: FloatArray) -> FloatArray:
        """Project each point (N, 3) at the time of its row (N,)."""
        T = invert(AHEAD @ se3_exp(rows[:, None] * camera.line_delay_ns / 1e9 * twist))
        in_camera = np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]
        return project(camera, in_camera)[0]

    image = lens.image(AHEAD @ se3_exp(lens.offsets_ns[:, None] / 1e9 * twist))

    points = wall().points(spots())
    first = px = at_rows(np.zeros(len(points)), points)
    for _ in range(5):
        px = at_rows(px[:, 1], points)
    inside = (px > 10).all(axis=1) & (px < [309, 229]).all(axis=1)
    errors = [brightest(image, at) - at for at in px[inside]]
    shifts = (px - first)[inside]
    assert len(errors) >= 6
    assert np.abs(errors).max() < 0.15
    assert np.abs(shifts).max() > 3.0


def test_motion_blur_is_the_mean_over_the_exposure() -> None:
    camera = ViCameraConfig(width_px=320, height_px=240, lens="none").calibration("left")
    lens = Lens(Renderer([wall()]), camera)
    poses = AHEAD @ se3_exp(np.linspace(-0.02, 0.02, 5)[:, None] * [[0, 1, 0, 0, 0, 0]])

    blurred, sharp = lens.image(poses[:, None]), lens.image(poses[2:3])

    px = project(camera, (invert(AHEAD) @ [*wall().points(spots()[[8]])[0], 1])[None, :3])[0][0]
    assert np.abs(brightest(blurred, px) - px).max() < 0.2
    assert blurred.max() < 0.8 * sharp.max()


def test_a_lens_that_looks_too_far_aside_is_refused() -> None:
    camera = ViCameraConfig(
        width_px=64, height_px=48, focal_px=15.0, lens="equidistant"
    ).calibration("left")

    with pytest.raises(ValueError, match="too far aside"):
        Lens(Renderer([wall()]), camera)


def test_depth_and_surface_are_those_of_the_ray() -> None:
    """Every pixel's point lies on the plane of its surface, and inside it."""
    crates = prism(
        "crate",
        SE3.exp([0, 0, 0.3, 2.0, 0.2, -1.0]),
        box_outline(0.6, 0.4),
        1.2,
        lambda _: grey(200),
    )
    tins = prism(
        "tin",
        SE3.exp([0, 0, 0, 1.6, 0.5, -0.5]),
        box_outline(0.2, 0.2)[:3],
        0.4,
        lambda _: grey(90),
    )
    surfaces = [wall(), *crates, *tins]
    T_world_camera = AHEAD @ se3_exp([-0.2, -0.05, 0.1, 0.1, -0.4, 0.1])

    view = Renderer(surfaces).rendering(CAMERA, T_world_camera)

    y, x = np.mgrid[0:240, 0:320]
    rays = np.linalg.inv(CAMERA.matrix) @ np.stack([x, y, np.ones_like(x)]).reshape(3, -1)
    points = (rays / np.maximum(view.inverse_depths.ravel(), 1e-6)).T
    points = points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    rows = view.surfaces.ravel()
    assert {surfaces[row].name for row in np.unique(rows[rows >= 0])} == {"wall", "crate", "tin"}
    for row in np.unique(rows[rows >= 0]):
        of_plane = points[rows == row] - surfaces[row].origin
        assert np.abs(of_plane @ surfaces[row].normal).max() < 1e-4
        st = of_plane @ np.stack([surfaces[row].right, surfaces[row].down], axis=1)
        inside = st @ surfaces[row].edges()[:, :2].T + surfaces[row].edges()[:, 2]
        assert inside.min() > -1e-3


def test_what_is_near_hides_what_is_far_in_any_order() -> None:
    def board(x: float, level: int) -> Surface:
        half = 0.2 * x
        return rectangle(
            "board", [x, half, half], [0, -2 * half, 0], [0, 0, -2 * half], lambda _: grey(level)
        )

    middle = (118, 160)
    near, far = board(1, 50), board(2, 150)

    views = [
        Renderer([wall(), *boards]).rendering(CAMERA, AHEAD)
        for boards in ([near, far], [far, near])
    ]

    for view in views:
        assert view.image[middle] == 50
        assert view.inverse_depths[middle] == pytest.approx(1.0, rel=1e-5)
    edges = occluding_edges(views[0], 0.5)
    assert edges.sum() == pytest.approx(2 * (120 + 124), abs=8)
    assert not edges[middle]


def test_a_floor_under_and_behind_the_camera_is_cut_at_it() -> None:
    floor = rectangle(
        "floor", [-5, 5, -1], [10, 0, 0], [0, -10, 0], lambda _: grey(77), is_shell=True
    )

    image = Renderer([floor]).image(CAMERA, AHEAD)

    horizon = 118 + 310 / 5  # the floor's far end, a metre below
    assert (image[: int(horizon)] == 0).all()
    assert (image[int(horizon) + 2 :, 100:220] == 77).all()


def test_seams_between_the_parts_of_a_wall_are_not_seen() -> None:
    plain = rectangle("wall", [3, 6, 4], [0, -12, 0], [0, 0, -8], lambda _: grey(99), is_shell=True)

    image = Renderer([plain]).image(CAMERA, AHEAD @ se3_exp([0.2, 0.3, 0.1, 0, 0, 0]))

    assert (image == 99).all()
