"""LiDAR-inertial odometry against motions that are known, and against scans that say too little."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np
import pytest

from mapstream.operators.imu.parameters import ImuQuality
from mapstream.operators.odometry.gicp_odometry import GicpOdometry, GicpOdometryConfig
from mapstream.operators.odometry.kiss_odometry import KissOdometry, KissOdometryConfig
from mapstream.operators.odometry.lidar_inertial.lidar_inertial_odometry import (
    LidarInertialOdometry,
    LidarInertialOdometryConfig,
)
from mapstream.operators.odometry.lidar_inertial.propagation import propagate, way_to
from mapstream.operators.odometry.lidar_inertial.state import SIZE, LidarInertialState
from mapstream.operators.odometry.visual_inertial.propagation import Motion
from mapstream.operators.operator import Context
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import ImuConfig
from mapstream.recordings.evaluation import ape
from mapstream.recordings.pose_pairs import PosePairs
from mapstream.recordings.worlds.ring import Ring
from mapstream.recordings.worlds.sensors import LidarConfig
from mapstream.recordings.worlds.w_lid import START_NS, WLidConfig, drive, w_lid
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import so3_exp, so3_log
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch, LidarScan

pytestmark = pytest.mark.anyio
IMU = ImuConfig(
    gyro_density=1.7e-4, accel_density=2e-3, gyro_random_walk=2e-5, accel_random_walk=3e-4
)
CONFIG = LidarInertialOdometryConfig(imu=IMU)


@dataclass(frozen=True, slots=True)
class Drive:
    """The first seconds of W-LID, with spins."""

    world: WLidConfig
    scans: list[LidarScan]
    imu: list[ImuBatch]

    def truth(self, stamps_ns: Sequence[int]) -> FloatArray:
        return drive(Ring(self.world.length_m), self.world).poses(np.array(stamps_ns))

    def pairs(self, found: Sequence[Odometry]) -> PosePairs:
        stamps_ns = [each.stamp_ns for each in found]
        poses = np.array([each.T_odom_base.matrix for each in found])
        return PosePairs(
            stamps_ns=np.array(stamps_ns), estimate=poses, reference=self.truth(stamps_ns)
        )

    def error_m(self, found: Sequence[Odometry]) -> float:
        return ape(self.pairs(found)).translation.rmse


@pytest.fixture(scope="module")
def spins() -> Drive:
    lidar = LidarConfig(beams=16, columns=180)
    world = WLidConfig(length_m=40.0, aggressive=True, lidar=lidar)
    end_ns = START_NS + 7_000_000_000
    records = takewhile(lambda record: record.log_ns <= end_ns, w_lid(world, 0).records)
    messages = [record.message for record in records]
    scans = [message for message in messages if isinstance(message, LidarScan)]
    return Drive(world, scans, [each for each in messages if isinstance(each, ImuBatch)])


async def estimate(
    scans: Sequence[LidarScan], imu: Sequence[ImuBatch], context: Context | None = None
) -> list[Odometry]:
    operator = LidarInertialOdometry(CONFIG)
    out = await run_operator(operator, run_context=context, scans=scans, imu=imu)
    assert [cloud.stamp_ns for cloud in out["clouds"]] == [o.stamp_ns for o in out["odometry"]]
    return list(out["odometry"])


@pytest.mark.slow
async def test_C12_half_the_error_of_lidar_alone_where_it_spins(spins: Drive) -> None:
    scans = spins.scans[:50]
    found = await estimate(scans, spins.imu)

    assert len(found) == len(scans)
    assert not any(each.is_lost for each in found)
    error_m = spins.error_m(found)
    alone: list[Callable[[], KissOdometry | GicpOdometry]] = [
        lambda: KissOdometry(KissOdometryConfig()),
        lambda: GicpOdometry(GicpOdometryConfig()),
    ]
    for make in alone:
        out = await run_operator(make(), scans=scans)
        assert error_m < 0.5 * spins.error_m(out["odometry"])


@pytest.mark.slow
@pytest.mark.parametrize("start_s", [0.0, 4.0])
async def test_C12_velocity_biases_and_up_are_found_from_rest_and_in_motion(
    spins: Drive, start_s: float
) -> None:
    start_ns = START_NS + round(start_s * 1e9)
    scans = [scan for scan in spins.scans if scan.stamp_ns >= start_ns][:35]

    found = await estimate(scans, spins.imu)

    assert len(found) == len(scans)
    assert spins.error_m(found) < 0.02
    last = found[-1]
    motion = drive(Ring(spins.world.length_m), spins.world)
    truth = motion.poses(np.array([last.stamp_ns]))[0]
    true_up, up = truth[2, :3], last.T_odom_base.R[2]
    assert np.degrees(np.arccos(np.clip(up @ true_up, -1, 1))) < 0.5
    velocity = motion.velocities(np.array([last.stamp_ns]))[0]
    assert last.velocity_mps is not None
    np.testing.assert_allclose(
        last.T_odom_base.R.T @ last.velocity_mps, truth[:3, :3].T @ velocity, atol=0.05
    )
    assert found[0].T_odom_base.t == pytest.approx(np.zeros(3), abs=1e-9)


async def test_a_scan_of_something_else_is_lost_and_the_imu_bridges_it(spins: Drive) -> None:
    scans = list(spins.scans[:25])
    rng = np.random.default_rng(0)
    nonsense = rng.uniform(-20, 20, scans[18].points.shape).astype(np.float32)
    scans[18] = replace(scans[18], points=nonsense)
    context = Context()

    found = await estimate(scans, spins.imu, context)

    assert [each.is_lost for each in found] == [k == 18 for k in range(25)]
    assert found[18].covariance is not None
    assert found[18].covariance[5, 5] > 1.0
    assert spins.error_m(found) < 0.02
    assert any("do not fit the map" in warning for warning in context.activity.warnings)


async def test_what_cannot_be_used_is_said(spins: Drive) -> None:
    context = Context()
    late = [replace(batch, stamps_ns=batch.stamps_ns + 10**10) for batch in spins.imu[:1]]

    assert await estimate(spins.scans[:2], late, context) == []
    assert await estimate(spins.scans[:2], spins.imu, context) == []

    warnings = " ".join(context.activity.warnings)
    assert "before the first sample" in warnings
    assert "too few scans" in warnings


def _state() -> LidarInertialState:
    rng = np.random.default_rng(1)
    return LidarInertialState(
        stamp_ns=0,
        R=so3_exp([0.1, -0.2, 1.0]),
        p=np.array([1.0, 2.0, 0.5]),
        v=np.array([2.0, -1.0, 0.1]),
        gyro_bias=rng.normal(0, 0.01, 3),
        accel_bias=rng.normal(0, 0.1, 3),
        gravity=np.array([0.05, -0.02, -9.81]),
        covariance=np.zeros((SIZE, SIZE)),
    )


def _motion() -> Motion:
    rng = np.random.default_rng(2)
    stamps_ns = np.arange(21) * 5_000_000
    gyro = np.array([0.3, -0.1, 1.2]) + rng.normal(0, 0.05, (21, 3))
    accel = np.array([0.0, 0.0, 9.81]) + rng.normal(0, 1, (21, 3))
    return Motion(stamps_ns, gyro, accel, np.zeros(20, bool))


def _difference(after: LidarInertialState, before: LidarInertialState) -> FloatArray:
    return np.concatenate(
        [
            so3_log(before.R.T @ after.R),
            after.p - before.p,
            after.v - before.v,
            after.gyro_bias - before.gyro_bias,
            after.accel_bias - before.accel_bias,
            after.gravity - before.gravity,
        ]
    )


@pytest.mark.parametrize("axis", range(SIZE))
def test_errors_of_the_state_go_on_as_numerical_derivatives_say(axis: int) -> None:
    step, motion = np.zeros(SIZE), _motion()
    step[axis] = 1e-5
    imu = ImuQuality(
        gyro_density=1e-12, accel_density=1e-12, gyro_random_walk=1e-12, accel_random_walk=1e-12
    )
    moved, still = _state().corrected(step, np.outer(step, step)), _state()

    propagate(moved, motion, imu)
    propagate(still, motion, imu)

    expected = np.outer(*[_difference(moved, still)] * 2)
    np.testing.assert_allclose(moved.covariance, expected, atol=0.01 * np.abs(expected).max())


def test_the_way_back_is_the_way_that_was_come() -> None:
    state, motion = _state(), _motion()
    path = propagate(state, motion, ImuQuality())

    back = way_to(state, motion)

    np.testing.assert_allclose(back.poses, path.poses, atol=1e-5)
