"""The gyroscope's rotation between images, and the table of rays that makes it cheap to use."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapstream.operators.tracking.rays import rays
from mapstream.operators.tracking.turning import camera_turn, turned_px
from mapstream.recordings.worlds.vi_rig import LensName, ViCameraConfig
from mapstream.streams.camera_models import project, unproject
from mapstream.streams.geometry import SE3, so3_exp, so3_log
from mapstream.streams.messages.sensors import ImuBatch

_LENSES: tuple[LensName, ...] = ("none", "radtan", "rational", "equidistant", "fov", "unified")


def _batches(rate: np.ndarray, stamps_ns: np.ndarray, T_base_imu: SE3) -> list[ImuBatch]:
    """Return samples of an IMU that turns steadily with the base, in two batches."""
    rates = np.tile(T_base_imu.R.T @ rate, (len(stamps_ns), 1))
    halves = (slice(None, len(stamps_ns) // 2), slice(len(stamps_ns) // 2, None))
    return [
        ImuBatch(
            stamps_ns=stamps_ns[half],
            gyro_radps=rates[half],
            accel_mps2=np.zeros_like(rates[half]),
            T_base_sensor=T_base_imu,
        )
        for half in halves
    ]


@given(st.integers(0, 2**32 - 1))
def test_a_steady_turn_is_exact_wherever_imu_and_camera_sit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rate = rng.normal(0, 1, 3)
    T_base_imu, T_base_camera = (SE3.exp(rng.normal(0, 1, 6)) for _ in range(2))
    stamps_ns = np.sort(rng.choice(90_000_000, 40, replace=False)) - 20_000_000
    start_ns, end_ns = int(stamps_ns[3]) + 1, int(stamps_ns[-3]) - 1

    turn = camera_turn(_batches(rate, stamps_ns, T_base_imu), start_ns, end_ns, T_base_camera)

    assert turn is not None
    R_start_end = so3_exp(T_base_camera.R.T @ rate * (end_ns - start_ns) / 1e9)
    np.testing.assert_allclose(turn, R_start_end.T, atol=1e-9)


def test_a_changing_rate_is_integrated_between_its_samples() -> None:
    stamps_ns = np.arange(0, 200_000_000, 5_000_000)
    times = stamps_ns / 1e9
    batch = ImuBatch(
        stamps_ns=stamps_ns,
        gyro_radps=np.outer(np.sin(20 * times), [0, 0, 2.0]),
        accel_mps2=np.zeros((len(times), 3)),
    )

    turn = camera_turn([batch], 12_000_000, 151_000_000, SE3.identity())

    assert turn is not None
    angle = 2.0 / 20 * (np.cos(20 * 0.012) - np.cos(20 * 0.151))
    np.testing.assert_allclose(so3_log(turn), [0, 0, -angle], atol=2e-4)


@pytest.mark.parametrize(
    "stamps_ns",
    [
        np.arange(0, 40_000_000, 5_000_000),  # ends too early
        np.arange(15_000_000, 90_000_000, 5_000_000),  # begins too late
        np.append(np.arange(0, 20_000_000, 5_000_000), [130_000_000, 135_000_000]),  # a gap
    ],
)
def test_what_the_samples_do_not_tell_is_not_known(stamps_ns: np.ndarray) -> None:
    batches = _batches(np.ones(3), stamps_ns, SE3.identity())

    assert camera_turn(batches, 10_000_000, 60_000_000, SE3.identity()) is None
    assert camera_turn([], 10_000_000, 60_000_000, SE3.identity()) is None


@pytest.mark.parametrize("lens", _LENSES)
def test_rays_of_the_table_are_those_of_the_lens(lens: LensName) -> None:
    camera = ViCameraConfig(lens=lens, width_px=320, height_px=240).calibration("front_left")
    px = np.random.default_rng(1).uniform([0, 0], [319, 239], (500, 2))

    again, is_seen = project(camera, rays(camera, px))

    exact = np.isfinite(unproject(camera, px)).all(axis=1)
    assert exact.mean() > 0.9
    assert is_seen[exact].mean() > 0.98  # the table ends a cell before the lens does
    assert np.linalg.norm(again - px, axis=1)[exact & is_seen].max() < 0.05


@pytest.mark.parametrize("lens", _LENSES)
def test_far_points_go_where_the_turn_takes_them(lens: LensName) -> None:
    camera = ViCameraConfig(lens=lens, width_px=320, height_px=240).calibration("rear")
    turn = so3_exp([0.02, -0.1, 0.05])
    px = np.random.default_rng(2).uniform([60, 50], [260, 190], (200, 2)).astype(np.float32)

    exact, _ = project(camera, unproject(camera, px.astype(np.float64)) @ turn.T)

    assert np.linalg.norm(turned_px(camera, px, turn) - exact, axis=1).max() < 0.05
    np.testing.assert_array_equal(turned_px(camera, px, None), px)
    np.testing.assert_array_equal(turned_px(None, px, turn), px)
    behind = so3_exp([0, 3.0, 0])  # what leaves the view stays, to be looked for and not found
    assert np.isfinite(turned_px(camera, px, behind)).all()
