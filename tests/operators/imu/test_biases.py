"""Biases of an IMU, in motion and at rest."""

from __future__ import annotations

import numpy as np
import pytest

from mapstream.operators.estimation.factors.inertial import Bias
from mapstream.operators.imu.biases import ImuBiases, ImuBiasesConfig
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.streams.arrays import FloatArray, IntArray
from mapstream.streams.errors import EstimationError
from mapstream.streams.geometry import SE3, se3_exp, so3_exp
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch
from tests.operators.estimation.test_inertial import Flight

pytestmark = pytest.mark.anyio
BIAS = Bias(np.array([0.03, -0.04, 0.05]), np.array([0.1, 0.2, -0.15]))
MOUNT = SE3.from_rotation(so3_exp([0.1, 0.2, 1.5]), [0.2, 0.1, -0.1])
RATE_HZ = 200


def batches(gyro: FloatArray, accel: FloatArray, stamps: IntArray, seed: int) -> list[ImuBatch]:
    """Samples with the noise of a MEMS, a tenth of a second at a time."""
    rng = np.random.default_rng(seed)
    gyro = gyro + rng.normal(0, 1e-3 * np.sqrt(RATE_HZ), gyro.shape)
    accel = accel + rng.normal(0, 1e-2 * np.sqrt(RATE_HZ), accel.shape)
    return [
        ImuBatch(
            stamps_ns=stamps[rows],
            gyro_radps=gyro[rows],
            accel_mps2=accel[rows],
            T_base_sensor=MOUNT,
        )
        for rows in (slice(at, at + 20) for at in range(0, len(stamps), 20))
    ]


def flight(seconds: float, seed: int) -> tuple[list[ImuBatch], list[Odometry]]:
    rng = np.random.default_rng(seed)
    stamps = np.arange(0, round(seconds * 1e9), 5_000_000, dtype=np.int64)
    samples = Flight().samples(stamps, MOUNT, BIAS)
    at_ns = np.arange(50_000_000, round((seconds - 0.1) * 1e9), 100_000_000, dtype=np.int64)
    noise = se3_exp(rng.normal(size=(len(at_ns), 6)) * np.repeat([0.001, 0.005], 3))
    frame = se3_exp([0.2, 0.3, 1.0, 5.0, 6.0, 7.0])  # the odometry's is not level
    odometry = [
        Odometry(stamp_ns=int(stamp), T_odom_base=SE3(pose))
        for stamp, pose in zip(at_ns, frame @ Flight().poses(at_ns / 1e9) @ noise, strict=True)
    ]
    return batches(samples.gyro_radps, samples.accel_mps2, stamps, seed), odometry


@pytest.mark.parametrize("seed", range(3))
async def test_C13_A10_biases_in_motion(seed: int) -> None:
    """Gyroscope within 10 %, accelerometer within 0.05 m/s^2; velocities within 5 cm/s."""
    imu, odometry = flight(14.0, seed)

    made = await run_operator(
        ImuBiases(ImuBiasesConfig(sigma_rad=0.0015, sigma_m=0.007)), imu=imu, odometry=odometry
    )

    out: list[Odometry] = made["odometry"]
    assert [o.stamp_ns for o in out] == [o.stamp_ns for o in odometry]
    assert all(o.T_odom_base is given.T_odom_base for o, given in zip(out, odometry, strict=True))
    for message in out:
        assert message.gyro_bias_radps is not None
        assert message.accel_bias_mps2 is not None
        error = np.linalg.norm(message.gyro_bias_radps - BIAS.gyro_radps)
        assert error < 0.1 * np.linalg.norm(BIAS.gyro_radps)
        assert np.linalg.norm(message.accel_bias_mps2 - BIAS.accel_mps2) < 0.05
    frame = se3_exp([0.2, 0.3, 1.0, 5.0, 6.0, 7.0])[:3, :3]
    early = [(o.stamp_ns / 1e9, o.velocity_mps) for o in out if o.velocity_mps is not None]
    assert len(early) >= 48
    errors = [velocity - frame @ Flight().velocity(at_s) for at_s, velocity in early]
    assert np.sqrt(np.mean(np.sum(np.square(errors), axis=1))) < 0.05


@pytest.mark.parametrize("seed", range(2))
async def test_C13_biases_at_rest(seed: int) -> None:
    """Of the accelerometer only the part along gravity shows; the pose is upright."""
    tilt = so3_exp([0.2, -0.1, 0.0]) @ MOUNT.R
    up = tilt.T @ [0, 0, 1.0]
    stamps = np.arange(0, 5_500_000_000, 5_000_000, dtype=np.int64)
    ones = np.ones((len(stamps), 1))
    context = Context(name="imu_biases")
    imu = batches(ones * BIAS.gyro_radps, ones * (9.81 * up + 0.12 * up), stamps, seed)

    made = await run_operator(ImuBiases(ImuBiasesConfig()), run_context=context, imu=imu)

    (pose,) = made["odometry"]
    assert np.linalg.norm(pose.gyro_bias_radps - BIAS.gyro_radps) < 0.1 * 0.07
    assert np.linalg.norm(pose.accel_bias_mps2 - 0.12 * up) < 0.05
    np.testing.assert_array_equal(pose.velocity_mps, np.zeros(3))
    assert np.degrees(np.arccos(pose.T_odom_base.R[2] @ (MOUNT.R @ up))) < 0.3
    assert any("tilt" in warning for warning in context.activity.warnings)


async def test_C13_an_imu_that_never_rests_needs_odometry() -> None:
    imu, _ = flight(6.0, 1)

    with pytest.raises(EstimationError, match="never stood still for 5 s; connect odometry"):
        await run_operator(ImuBiases(ImuBiasesConfig()), imu=imu)


async def test_C13_short_recordings_make_do_with_what_there_is() -> None:
    imu, odometry = flight(2.0, 2)
    context = Context(name="imu_biases")

    short = await run_operator(ImuBiases(ImuBiasesConfig()), imu=imu, odometry=odometry)
    none = await run_operator(
        ImuBiases(ImuBiasesConfig()), run_context=context, imu=imu, odometry=odometry[:1]
    )

    assert short["odometry"][0].gyro_bias_radps is not None
    assert none["odometry"] == odometry[:1]
    assert any("too little in common" in warning for warning in context.activity.warnings)


async def test_A10_odometry_that_has_biases_keeps_them() -> None:
    imu, odometry = flight(6.0, 3)
    own = np.array([1.0, 2.0, 3.0])
    given = [
        Odometry(
            stamp_ns=o.stamp_ns, T_odom_base=o.T_odom_base, gyro_bias_radps=own, velocity_mps=own
        )
        for o in odometry
    ]

    made = await run_operator(ImuBiases(ImuBiasesConfig()), imu=imu, odometry=given)

    assert all(np.array_equal(o.gyro_bias_radps, own) for o in made["odometry"])
    assert all(np.array_equal(o.velocity_mps, own) for o in made["odometry"])
