"""Planes in depth images of W-RGBD, against the room's own surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import islice

import numpy as np
import pytest

from mapstream.operators.operator import Context, set_context
from mapstream.operators.planes.plane_segmentation import (
    PlaneSegmentation,
    PlaneSegmentationConfig,
)
from mapstream.operators.testing import run_operator
from mapstream.recordings.worlds.orbit import orbit
from mapstream.recordings.worlds.w_2d import W2dConfig, w_2d
from mapstream.recordings.worlds.w_rgbd import (
    START_NS,
    T_BASE_CAMERA,
    RgbdWorld,
    WRgbdConfig,
    rgbd_world,
)
from mapstream.streams.arrays import FloatArray
from mapstream.streams.errors import OperatorError
from mapstream.streams.messages.planes import PlaneSegments
from mapstream.streams.messages.sensors import CameraFrame

LEAST = 10_000


@cache
def world() -> RgbdWorld:
    return rgbd_world(WRgbdConfig(texel_m=0.05), 0)


@dataclass(frozen=True)
class Shot:
    T_world_base: FloatArray
    depth: CameraFrame
    surfaces: np.ndarray  # (H, W) the true surface of each pixel; -1 where there is no depth


@cache
def shot(time_s: float) -> Shot:
    stamp_ns = START_NS + round(time_s * 1e9)
    pose = orbit(40.0, START_NS).poses(np.array([stamp_ns]))[0]
    camera = pose @ T_BASE_CAMERA.matrix
    _, depth = world().camera.take(round(time_s * 10), stamp_ns, camera)
    surfaces = np.where(depth.image > 0, world().camera.ideal(camera).surfaces, -1)
    calibration = WRgbdConfig().camera.calibration("depth")
    return Shot(pose, replace(depth, camera=calibration), surfaces)


def found(time_s: float) -> tuple[PlaneSegments, np.ndarray]:
    planes, labels = PlaneSegmentation(PlaneSegmentationConfig()).segment(shot(time_s).depth)
    return planes, labels.image


def off_surface(
    planes: PlaneSegments, row: int, pose: FloatArray, number: int
) -> tuple[float, float]:
    """The angle [deg] to a true surface and how far the segment's middle is from it [m]."""
    surface = world().room.surfaces[number]
    T = pose @ planes.T_base_plane[row]
    angle = np.rad2deg(np.arccos(np.clip(T[:3, 2] @ surface.normal, -1, 1)))
    return float(angle), float(abs(surface.normal @ (T[:3, 3] - surface.origin)))


@pytest.mark.slow
@pytest.mark.parametrize("time_s", [0.0, 8.0, 16.0, 28.0])
def test_N1_D21_all_large_planes_are_found_where_they_are(time_s: float) -> None:
    """Normals within 1 deg, places within 1 cm; a surface cut by what stands before it may be two planes."""
    planes, labels = found(time_s)

    seen = shot(time_s)
    numbers, counts = np.unique(seen.surfaces[seen.surfaces >= 0], return_counts=True)
    for number in numbers[counts >= LEAST]:
        rows = np.unique(labels[seen.surfaces == number])
        covered = np.isin(labels, rows[rows > 0])[seen.surfaces == number].mean()
        assert covered > 0.9, world().room.surfaces[number].name
    for row in range(len(planes)):
        inside = seen.surfaces[labels == row + 1]
        number = np.bincount(inside[inside >= 0]).argmax()
        angle_deg, offset_m = off_surface(planes, row, seen.T_world_base, int(number))
        assert angle_deg < 1.0
        assert offset_m < 0.01
        assert planes.num_points[row] >= LEAST
        assert (labels == row + 1).sum() == planes.num_points[row]


def test_N1_the_outline_holds_the_plane_and_no_more() -> None:
    """Of the table, which is 1.4 m x 0.8 m, all seen but what lies on it: nothing sticks out."""
    planes, _ = found(8.0)
    T = shot(8.0).T_world_base @ planes.T_base_plane

    (row,) = np.flatnonzero((np.abs(T[:, 2, 3] - 0.75) < 0.02) & (T[:, 2, 2] > 0.99))

    corners = planes.hulls_m[row] @ T[row, :3, :2].T + T[row, :3, 3]
    assert np.abs(corners[:, 0]).max() < 0.73
    assert np.abs(corners[:, 1]).max() < 0.43
    assert np.ptp(corners[:, 0]) > 1.2


def test_N1_how_sure_a_plane_is_grows_with_its_distance() -> None:
    """What the noise of pixels makes of it, for the same number of them: deviations go with the square of depth."""
    exact = PlaneSegmentation(PlaneSegmentationConfig(sigma_rad=0.0, sigma_m=0.0))
    camera = WRgbdConfig().camera.calibration("depth")
    sigmas = []
    for depth_m in (1.0, 2.0, 4.0):
        image = np.full((480, 640), 1000 * depth_m, np.uint16)
        planes, _ = exact.segment(
            CameraFrame(stamp_ns=0, image=image, encoding="16UC1", camera=camera)
        )
        sigmas.append(np.sqrt(planes.covariances[0, 5, 5]))
        assert planes.T_base_plane[0, 2, 3] == pytest.approx(depth_m, abs=1e-3)
        np.testing.assert_allclose(planes.T_base_plane[0, :3, 2], [0, 0, -1], atol=1e-6)

    ratios = np.array(sigmas) / sigmas[0]
    depths = np.array([1.0, 2.0, 4.0])
    expected = 0.0012 + 0.0019 * (depths - 0.4) ** 2
    np.testing.assert_allclose(ratios, expected / expected[0], rtol=0.02)


def test_N1_the_covariance_is_that_of_the_errors() -> None:
    """A slanted plane with the noise of a depth camera, 30 times: chi2 is what three unknowns make."""
    exact = PlaneSegmentation(
        PlaneSegmentationConfig(sigma_rad=0.0, sigma_m=0.0, min_pixels=1000, window_px=7)
    )
    camera = WRgbdConfig().camera.calibration("depth").resized(80, 60)
    x = (np.arange(80) - camera.center_px[0]) / camera.focal_px[0]
    inverse = np.tile(0.5 + 0.3 * x, (60, 1))  # q = (0.3, 0, 0.5)
    depth_m = 1 / inverse
    sigma_m = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    rng = np.random.default_rng(3)
    chi2 = []
    for _ in range(30):
        image = (depth_m + rng.normal(0, 1, depth_m.shape) * sigma_m).astype(np.float32)
        planes, _ = exact.segment(
            CameraFrame(stamp_ns=0, image=image, encoding="32FC1", camera=camera)
        )
        T, measured = planes.T_base_plane[0], [0, 1, 5]
        q = np.array([0.3, 0.0, 0.5])
        normal = T[:3, :3].T @ (-q / np.linalg.norm(q))
        off = (q @ T[:3, 3] - 1) / np.linalg.norm(q)
        error = np.array([-normal[1], normal[0], off])
        chi2.append(
            error @ np.linalg.solve(planes.covariances[0][np.ix_(measured, measured)], error)
        )

    assert 1.8 < np.mean(chi2) < 12.0


@pytest.mark.anyio
async def test_labels_and_planes_come_together_and_may_be_thinned() -> None:
    camera = WRgbdConfig().camera.calibration("depth").resized(80, 60)
    image = np.full((60, 80), 2000, np.uint16)
    frames = [
        CameraFrame(stamp_ns=at * 10**8, image=image, encoding="16UC1", camera=camera)
        for at in range(8)
    ]
    config = PlaneSegmentationConfig(min_pixels=500, window_px=5, period_s=0.3)
    set_context(Context())

    sent = await run_operator(PlaneSegmentation(config), frames=frames)

    assert [planes.stamp_ns // 10**8 for planes in sent["planes"]] == [0, 3, 6]
    assert (sent["labels"][0].image == 1).mean() > 0.95
    assert [len(planes) for planes in sent["planes"]] == [1, 1, 1]


def test_an_image_without_planes_has_none_and_one_without_calibration_is_refused() -> None:
    empty = CameraFrame(stamp_ns=0, image=np.zeros((60, 80), np.uint16), encoding="16UC1")
    camera = WRgbdConfig().camera.calibration("depth").resized(80, 60)
    operator = PlaneSegmentation(PlaneSegmentationConfig())

    planes, labels = operator.segment(replace(empty, camera=camera))

    assert len(planes) == 0
    assert not labels.image.any()
    with pytest.raises(OperatorError, match="has no calibration"):
        operator.segment(empty)


def test_a_wall_of_which_hardly_a_spot_is_flat_enough_is_a_plane_too() -> None:
    """Fewer than three flat spots made a system of equations without a solution."""
    robot = {
        "width_m": 14.0,
        "laps": 0.25,
        "wheels_hz": 1.0,
        "laser": {"rate_hz": 0.5},
        "depth": {"columns": 160, "rows": 120, "rate_hz": 2.0},
    }
    records = w_2d(W2dConfig.model_validate(robot), 0).records
    frames = (r.message for r in records if isinstance(r.message, CameraFrame))
    frame = next(islice(frames, 20, None))

    config = PlaneSegmentationConfig(min_pixels=700, window_px=7)
    planes, labels = PlaneSegmentation(config).segment(frame)

    assert len(planes) == labels.image.max() > 2
    assert np.isfinite(planes.T_base_plane).all()
