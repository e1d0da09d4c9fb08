"""Visual-inertial odometry against motions that are known, and against input that lacks something."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.odometry.visual_inertial.visual_inertial_odometry import (
    VisualInertialOdometry,
    VisualInertialOdometryConfig,
)
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import ImuConfig
from mapstream.recordings.evaluation import align, ape
from mapstream.recordings.pose_pairs import PosePairs
from mapstream.streams.errors import EstimationError
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch
from mapstream.streams.messages.vision import NFrame
from tests.operators.odometry.flight import START_NS, Flight

pytestmark = pytest.mark.anyio
QUIET = ImuConfig(gyro_density=2e-4, accel_density=2e-3)


async def estimate(
    frames: Sequence[NFrame], imu: ImuBatch, context: Context | None = None
) -> list[Odometry]:
    config = VisualInertialOdometryConfig(imu=QUIET, sigma_px=0.5, start_window_s=2.0)
    out = await run_operator(
        VisualInertialOdometry(config), run_context=context, n_frames=frames, imu=[imu]
    )
    return out["odometry"]


def pairs(flight: Flight, found: Sequence[Odometry]) -> PosePairs:
    stamps = np.array([each.stamp_ns for each in found])
    poses = np.array([each.T_odom_base.matrix for each in found])
    return PosePairs(stamps_ns=stamps, estimate=poses, reference=flight.truth(stamps))


def error_m(flight: Flight, found: Sequence[Odometry]) -> float:
    return ape(pairs(flight, found)).translation.rmse


@pytest.mark.parametrize("rest_s", [0.0, 1.0])
@pytest.mark.parametrize("num_cameras", [1, 2])
async def test_C9_pose_velocity_and_biases_are_found(rest_s: float, num_cameras: int) -> None:
    flight = Flight(rest_s=rest_s, num_cameras=num_cameras)

    found = await estimate(flight.frames(), flight.imu())

    assert error_m(flight, found) < 0.03
    assert found[-1].gyro_bias_radps == pytest.approx(flight.gyro_bias, abs=3e-3)
    assert found[-1].accel_bias_mps2 == pytest.approx(flight.accel_bias, abs=0.05)
    assert found[-1].velocity_mps is not None
    last = np.array([found[-1].stamp_ns])
    step_ns = 1_000_000
    velocity = (flight.truth(last + step_ns) - flight.truth(last - step_ns))[0, :3, 3] / 2e-3
    assert np.linalg.norm(found[-1].velocity_mps) == pytest.approx(
        np.linalg.norm(velocity), abs=0.03
    )
    assert not any(each.is_lost for each in found)


async def test_A2_one_camera_gives_a_metric_path() -> None:
    flight = Flight(duration_s=6.0)

    found = await estimate(flight.frames(), flight.imu())

    assert align(pairs(flight, found), "sim3").scale == pytest.approx(1, abs=0.02)


async def test_z_is_up_and_the_first_pose_is_level() -> None:
    flight = Flight(rest_s=1.0)

    found = await estimate(flight.frames(), flight.imu())

    turned = pairs(flight, found)
    up = turned.reference[:, 2, :3] - turned.estimate[:, 2, :3]
    assert np.abs(up[25:]).max() < 0.01  # at rest a bias of 0.1 m/s^2 looks like a tilt of 0.01 rad


async def test_the_same_input_gives_the_same_bytes() -> None:
    flight = Flight(duration_s=2.5)

    runs = [await estimate(flight.frames(), flight.imu()) for _ in range(2)]

    for a, b in zip(*runs, strict=True):
        assert a.T_odom_base.matrix.tobytes() == b.T_odom_base.matrix.tobytes()


async def test_the_covariance_of_steps_is_that_of_their_errors() -> None:
    flight = Flight(duration_s=6.0)

    found = await estimate(flight.frames(), flight.imu())

    both = pairs(flight, found)
    distances = []
    for k in range(5, len(found)):
        true = np.linalg.inv(both.reference[k - 1]) @ both.reference[k]
        step = found[k - 1].T_odom_base.inverse() @ found[k].T_odom_base
        error = (step.inverse() @ type(step)(true)).log()
        covariance = found[k].covariance
        assert covariance is not None
        distances.append(error @ np.linalg.solve(covariance, error))
    assert 4 < np.mean(distances) < 9  # 6 of an ideal filter


async def test_a_robot_that_stands_does_not_drift() -> None:
    flight = Flight(duration_s=2.0, rest_s=10.0)

    found = await estimate(flight.frames(), flight.imu())

    path = np.array([each.T_odom_base.t for each in found])
    assert np.ptp(path, axis=0).max() < 0.005
    assert found[-1].gyro_bias_radps == pytest.approx(flight.gyro_bias, abs=1e-3)


async def test_lost_images_are_bridged_and_named() -> None:
    flight = Flight(duration_s=6.0)
    frames = flight.frames()
    dark = slice(40, 45)
    frames[dark] = [NFrame(stamp_ns=f.stamp_ns, features=()) for f in frames[dark]]
    context = Context()

    found = await estimate(frames, flight.imu(), context)

    assert [each.is_lost for each in found][dark] == [True] * 5
    assert error_m(flight, found) < 0.05
    assert any("too few tracks" in each for each in context.activity.warnings)


async def test_a_gap_in_the_imu_is_bridged_and_named() -> None:
    flight = Flight(duration_s=6.0)
    imu = flight.imu()
    kept = np.abs(imu.stamps_ns - START_NS - 4_050_000_000) > 120_000_000
    imu = replace(
        imu,
        stamps_ns=imu.stamps_ns[kept],
        gyro_radps=imu.gyro_radps[kept],
        accel_mps2=imu.accel_mps2[kept],
    )
    context = Context()

    found = await estimate(flight.frames(), imu, context)

    assert error_m(flight, found) < 0.06
    assert any("gaps" in each for each in context.activity.warnings)


async def test_turning_on_the_spot_moves_nothing() -> None:
    flight = Flight(rest_s=1.0, swing_m=0.0, turn_rad=0.4, num_cameras=2)

    found = await estimate(flight.frames(), flight.imu())

    path = np.array([each.T_odom_base.t for each in found])
    assert np.linalg.norm(path, axis=1).max() < 0.03


async def test_false_tracks_are_refused() -> None:
    flight = Flight(duration_s=6.0)
    frames = flight.frames()
    rng = np.random.default_rng(5)
    for at, frame in enumerate(frames):
        (seen,) = frame.features
        px = np.array(seen.keypoints_px)
        assert seen.track_ids is not None
        false = seen.track_ids % 5 == 0
        px[false] += rng.uniform(-30, 30, (int(false.sum()), 2))
        frames[at] = replace(frame, features=(replace(seen, keypoints_px=px),))

    found = await estimate(frames, flight.imu())

    assert error_m(flight, found) < 0.06


async def test_no_image_at_all_is_no_odometry_and_a_warning() -> None:
    flight = Flight(duration_s=2.0)
    frames = [NFrame(stamp_ns=f.stamp_ns, features=()) for f in flight.frames()]
    context = Context()

    assert await estimate(frames, flight.imu(), context) == []
    assert any("no start" in each for each in context.activity.warnings)


async def test_a_camera_without_calibration_is_named() -> None:
    flight = Flight(duration_s=1.0)
    frames = [replace(f, features=(replace(f.features[0], camera=None),)) for f in flight.frames()]

    with pytest.raises(EstimationError, match="'cam0' without a camera model"):
        await estimate(frames, flight.imu())


async def test_clocks_that_are_apart_are_named() -> None:
    flight = Flight(duration_s=2.0)
    imu = flight.imu()
    early = replace(imu, stamps_ns=imu.stamps_ns + 3_600_000_000_000)
    late = replace(imu, stamps_ns=imu.stamps_ns - 3_600_000_000_000)
    contexts = Context(), Context()

    assert await estimate(flight.frames(), early, contexts[0]) == []
    assert await estimate(flight.frames(), late, contexts[1]) == []

    assert any("before the first sample" in each for each in contexts[0].activity.warnings)
    assert any("no start" in each for each in contexts[1].activity.warnings)


async def test_images_that_stay_dark_start_anew_where_the_robot_was() -> None:
    flight = Flight(duration_s=12.0)
    frames = flight.frames()
    frames[30:85] = [NFrame(stamp_ns=f.stamp_ns, features=()) for f in frames[30:85]]
    context = Context()

    found = await estimate(frames, flight.imu(), context)

    assert any("starts anew" in each for each in context.activity.warnings)
    again = [each for each in found if each.stamp_ns >= frames[100].stamp_ns]
    assert len(again) == 20
    assert error_m(flight, again) < 0.05
