"""From range and intensity to one image without gaps."""

from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.operators.lidar.images.grid import ScanGrid
from mapstream.operators.lidar.images.lidar_image import LidarImage, LidarImageConfig
from mapstream.operators.lidar.images.picture import (
    Painter,
    PictureConfig,
    eight_bits,
    fused,
    logarithmic,
    painted_over,
    range_gradient,
    smooth_intensity,
    wrapped,
)
from mapstream.operators.testing import run_operator
from tests.operators.lidar.images.corridors import Drive
from tests.operators.lidar.images.test_grid import staggered


@given(low=st.floats(0, 10), span=st.floats(0.5, 5000), k=st.floats(0.01, 50))
def test_D16_the_logarithmic_scale_hits_0_and_255_at_its_ends(
    low: float, span: float, k: float
) -> None:
    values = np.linspace(low, low + span, 40)

    scaled = logarithmic(values, low, low + span, k)

    np.testing.assert_allclose(scaled[[0, -1]], [0, 255], atol=0.01)
    assert (np.diff(scaled) > 0).all()
    np.testing.assert_array_equal(logarithmic(values - 2 * span, low, low + span, k)[0], 0)


def test_D16_the_scales_of_range_and_intensity_are_maplabs() -> None:
    assert logarithmic(np.array([1.1]), 0.1, 50.0, 1.0)[0] == pytest.approx(255 * np.log(2) / np.log(50.9))  # fmt: skip
    assert logarithmic(np.array([102.0]), 2, 3000, 5.0)[0] == pytest.approx(255 * np.log(501) / np.log(14991))  # fmt: skip


@pytest.mark.parametrize("fuse", ["gradient", "range"])
def test_D16_the_image_is_opencvs_fusion_of_the_two_channels(
    fuse: Literal["gradient", "range"],
) -> None:
    config = PictureConfig(fuse=fuse, min_intensity=2, max_intensity=3000)
    rng = np.random.default_rng(1)
    scan = staggered()
    scan = replace(scan, intensity=rng.uniform(0, 3000, len(scan.points)).astype(np.float32))
    projected = ScanGrid(config).project(scan)
    assert projected.is_measured.all()
    assert scan.intensity is not None

    image = Painter(config).paint(projected)

    scaled = logarithmic(wrapped(projected.range_m), 0.1, 50, 1)
    first = eight_bits(range_gradient(scaled) if fuse == "gradient" else scaled)
    bright = logarithmic(wrapped(scan.intensity[projected.point]), 2, 3000, 5)
    second = eight_bits(smooth_intensity(bright))
    expected = cv2.createMergeMertens().process([first, second])[:, 64:-64]
    np.testing.assert_array_equal(image, np.clip(np.rint(expected * 255), 0, 255))
    assert image.shape == (64, 2048)


def test_D16_range_gradient_is_the_mean_of_both_sobels() -> None:
    ramp = np.tile(np.arange(40, dtype=np.float32) * 3, (20, 1))

    np.testing.assert_allclose(range_gradient(ramp)[5:-5, 5:-5], 3 * 8 / 2)
    np.testing.assert_allclose(range_gradient(ramp.T.copy())[5:-5, 5:-5], 3 * 8 / 2)


def test_D16_missing_pixels_are_painted_from_their_neighbours() -> None:
    image = np.tile(np.linspace(50, 200, 64, dtype=np.float32), (32, 1))
    is_measured = np.random.default_rng(0).random(image.shape) > 0.3

    painted = painted_over(np.where(is_measured, image, 0), is_measured, radius_px=5)

    np.testing.assert_array_equal(painted[is_measured], image[is_measured])
    assert np.abs(painted - image).max() < 12


def test_D16_a_scan_with_holes_has_no_dark_pixel_left() -> None:
    """A wall all around with a fifth of the points lost: nowhere the black of a pixel without a range."""
    config = PictureConfig(fuse="range")
    scan = staggered()
    points = scan.points / np.linalg.norm(scan.points, axis=1, keepdims=True) * 8
    kept = np.random.default_rng(0).random(len(points)) > 0.2
    assert scan.ring is not None
    scan = replace(scan, points=points[kept], ring=scan.ring[kept])
    projected = ScanGrid(config).project(scan)
    assert 0.75 < projected.is_measured.mean() < 0.85

    image = Painter(config).paint(projected)

    assert np.ptp(image) <= 4


def test_fusing_needs_no_intensity_and_an_empty_scan_is_black() -> None:
    config = PictureConfig()
    empty = staggered()
    empty = replace(empty, points=np.zeros_like(empty.points))

    assert (Painter(config).paint(ScanGrid(config).project(empty)) == 0).all()
    channel = np.full((8, 8), 90, np.uint8)
    np.testing.assert_array_equal(fused(channel, channel), channel)


@pytest.mark.anyio
async def test_lidar_image_sends_one_image_per_scan(drive: Drive) -> None:
    scans = drive.scans[:2]

    sent = (await run_operator(LidarImage(LidarImageConfig()), scans=scans))["frames"]

    assert [frame.stamp_ns for frame in sent] == [scan.stamp_ns for scan in scans]
    assert sent[0].image.shape == (64, 1024)
    assert sent[0].encoding == "mono8"
    assert sent[0].image.std() > 10
    np.testing.assert_allclose(sent[0].T_base_sensor.matrix, scans[0].T_base_sensor.matrix)


def test_the_image_turns_with_the_sensor_and_has_no_seam(drive: Drive) -> None:
    """A scan turned by a quarter gives the image moved by a quarter of its columns."""
    scan = drive.scans[0]
    turned = scan.points[:, [1, 0, 2]] * np.array([-1, 1, 1], np.float32)  # to the left

    image = LidarImage(LidarImageConfig()).image(scan).image.astype(float)
    moved = LidarImage(LidarImageConfig()).image(replace(scan, points=turned)).image.astype(float)

    difference = np.abs(np.roll(image, -256, axis=1) - moved)
    assert np.percentile(difference, 99) < 6
    at_seam = difference[:, [0, 1, 255, 256, 511, 512, 767, 768, -2, -1]]
    assert at_seam.mean() < 3 * difference.mean() + 1
