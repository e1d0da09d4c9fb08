"""Directions that the surroundings leave open: found, reported, and left to another sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile

import gtsam
import numpy as np
import pytest

from mapstream.operators.backend.optimizer import Optimizer, OptimizerConfig
from mapstream.operators.estimation.noise import NoiseModels, noise_from_covariance
from mapstream.operators.lidar.observability import observability_of_planes
from mapstream.operators.lidar.sampling import voxel_indices
from mapstream.operators.lidar.scan_shape import OpenDirections, open_directions_of_scan
from mapstream.operators.odometry.continuous import ContinuousSource
from mapstream.operators.odometry.gicp_odometry import GicpOdometry, GicpOdometryConfig
from mapstream.operators.odometry.kiss_odometry import KissOdometry, KissOdometryConfig
from mapstream.operators.odometry.lidar_inertial.lidar_inertial_odometry import (
    LidarInertialOdometry,
    LidarInertialOdometryConfig,
)
from mapstream.operators.odometry.uncertainty import (
    bridged,
    chain,
    diagonal,
    open_directions,
)
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import (
    ImuConfig,
    OdometryConfig,
    TrajectoryConfig,
    WheelConfig,
)
from mapstream.operators.trajectory.trajectory import Trajectory
from mapstream.recordings.worlds.motion import Motion
from mapstream.recordings.worlds.ring import Ring
from mapstream.recordings.worlds.sensors import LidarConfig
from mapstream.recordings.worlds.w_lid import START_NS, WLidConfig, drive, w_lid
from mapstream.streams.arrays import FloatArray
from mapstream.streams.geometry import SE3, so3_exp
from mapstream.streams.messages.estimates import UNOBSERVED_VARIANCE, Odometry
from mapstream.streams.messages.sensors import ImuBatch, LidarScan, WheelOdometry
from tests.data import shared

ALONG = np.array([0.0, 0.0, 0.0, np.cos(0.4), np.sin(0.4), 0.0])  # a corridor's axis, seen askew


def corridor(num: int = 900, *, has_end: bool = False) -> tuple[FloatArray, FloatArray]:
    """Return points (N, 3) on floor and walls of a corridor along `ALONG`, and the surfaces' normals."""
    rng = np.random.default_rng(0)
    along, across, up = rng.uniform([-15, -2, -1], [15, 2, 2], (num, 3)).T
    surface = np.arange(num) % 4
    points = np.column_stack([along, across, up])
    points[surface == 0, 1], points[surface == 1, 1], points[surface == 2, 2] = 2, -2, -1
    points[surface == 3, 2] = 2
    normals = np.array([[0.0, -1, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]])[surface]
    if has_end:
        wall = slice(num // 6)
        points[wall] = np.column_stack([np.full(num, 15.0), across, up])[wall]
        normals[wall] = [-1, 0, 0]
    R = so3_exp([0, 0, 0.4])
    return points @ R.T, normals @ R.T


def test_U8_a_corridors_axis_is_open_and_nothing_else() -> None:
    found = observability_of_planes(*corridor(), rmse_m=0.01)

    assert found.unseen.shape == (1, 6)
    assert abs(found.unseen[0] @ ALONG) > 0.999
    assert ALONG @ found.covariance @ ALONG > 0.9 * UNOBSERVED_VARIANCE
    np.testing.assert_allclose(found.information @ found.unseen[0], 0, atol=1e-6)
    aside = np.array([0, 0, 0, -np.sin(0.4), np.cos(0.4), 0])
    assert aside @ found.covariance @ aside < 0.01**2


def test_U8_a_wall_at_its_end_closes_it() -> None:
    found = observability_of_planes(*corridor(has_end=True), rmse_m=0.01)

    assert not len(found.unseen)
    assert np.diagonal(found.covariance).max() < 0.1**2


def test_U8_open_ground_leaves_two_directions_and_the_heading() -> None:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-20, 20, (500, 2)), np.full(500, -1.5)])

    found = observability_of_planes(points, np.tile([0.0, 0, 1], (500, 1)), rmse_m=0.01)

    assert len(found.unseen) == 3
    assert np.linalg.matrix_rank(np.vstack([found.unseen, np.eye(6)[[2, 3, 4]]]), tol=0.01) == 3


def test_U8_a_scan_alone_shows_what_it_leaves_open() -> None:
    (found,) = open_directions_of_scan(corridor(4000)[0])

    assert abs(found @ ALONG) > 0.99
    assert not len(open_directions_of_scan(corridor(4000, has_end=True)[0]))


def test_U8_a_street_leaves_nothing_open() -> None:
    """Plants, poles and cars hold a scan, although most of the flat places are road."""
    for path in sorted(shared("kitti00_lidar").glob("*.bin"))[:3]:
        points = np.fromfile(path, np.float32).reshape(-1, 4)[:, :3].astype(np.float64)
        assert not len(open_directions_of_scan(points[voxel_indices(points, 0.5)]))


def test_scans_are_asked_seldom_where_much_holds_them_and_always_where_little_does() -> None:
    blank, closed = corridor(4000)[0], corridor(4000, has_end=True)[0]
    directions = OpenDirections()

    found = [len(directions.of(points)) for points in [closed, *[blank] * 6, closed, blank]]

    assert found == [0, 0, 0, 0, 1, 1, 1, 0, 0]


def test_U8_the_solver_gets_no_information_along_an_open_direction() -> None:
    """Exactly none, and the same as without it in all others; alone and among many."""
    rest = np.eye(6) - np.outer(ALONG, ALONG)
    known = diagonal(0.01, 0.02)
    covariance = known + UNOBSERVED_VARIANCE * np.outer(ALONG, ALONG)

    for noise in (noise_from_covariance(covariance), NoiseModels().of_all(covariance[None])[0]):
        information = noise.R().T @ noise.R()
        np.testing.assert_allclose(ALONG @ information @ ALONG, 0, atol=1e-9)
        expected = rest @ np.linalg.inv(known) @ rest
        np.testing.assert_allclose(information, expected, rtol=1e-4, atol=1e-3)


def test_U8_what_one_sensor_leaves_open_the_other_says() -> None:
    """One edge of a LiDAR that is 5 m wrong along the corridor, one of wheels."""
    T_true = SE3.exp([0, 0, 0.1, 1.0, 0.4, 0])
    T_lidar = T_true @ SE3.exp(5 * ALONG)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    lidar = diagonal(0.001, 0.005) + UNOBSERVED_VARIANCE * np.outer(ALONG, ALONG)
    wheels = np.diag([np.inf, np.inf, 0.02**2, 0.05**2, 0.05**2, np.inf])
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    for T, covariance in ((T_lidar, lidar), (T_true, wheels)):
        noise = noise_from_covariance(covariance)
        graph.add(gtsam.BetweenFactorPose3(0, 1, gtsam.Pose3(T.matrix), noise))
    values.insert(0, gtsam.Pose3())
    values.insert(1, gtsam.Pose3(T_lidar.matrix))

    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize().atPose3(1)

    np.testing.assert_allclose(found.matrix(), T_true.matrix, atol=1e-3)


def test_open_directions_stay_open_over_steps_and_parts_of_them() -> None:
    source = ContinuousSource(np.eye(6))
    covariance = diagonal(0.001, 0.005) + UNOBSERVED_VARIANCE * np.outer(ALONG, ALONG)
    for k in range(4):
        T = SE3.exp([0, 0, 0.0, 0.3 * k, 0, 0])
        source.add(Odometry(stamp_ns=k * 10**8, T_odom_base=T, covariance=covariance))

    over = source.between(3 * 10**7, 26 * 10**7).covariance

    (direction,) = open_directions(over)
    assert abs(direction @ ALONG) > 0.999


def test_noise_in_the_directions_of_steps_opens_no_others() -> None:
    rng = np.random.default_rng(0)
    total = np.zeros((6, 6))
    for _ in range(10):
        turn = SE3.exp([0, 0, rng.normal(0, 0.03), 0, 0, 0]).adjoint()
        direction = turn @ ALONG
        step = diagonal(0.001, 0.005) + UNOBSERVED_VARIANCE * np.outer(direction, direction)
        total = chain(total, SE3.exp([0, 0, 0, 0.1, 0, 0]), step)

    (direction,) = open_directions(total)
    assert abs(direction @ ALONG) > 0.998
    aside = np.cross([0, 0, 1], direction[3:])
    assert aside @ total[3:, 3:] @ aside < 0.1**2


def test_where_nothing_takes_a_direction_a_motion_model_bridges_it() -> None:
    covariance = diagonal(0.001, 0.005) + UNOBSERVED_VARIANCE * np.outer(ALONG, ALONG)

    closed = bridged(covariance, 1.0)

    assert not len(open_directions(closed))
    assert ALONG @ closed @ ALONG == pytest.approx(25.0)
    aside = np.array([0, 0, 0, -np.sin(0.4), np.cos(0.4), 0])
    assert aside @ closed @ aside == pytest.approx(0.005**2, rel=1e-3)


@dataclass(frozen=True, slots=True)
class Blank:
    """The first metres of a blank corridor whose ends are too far to be seen."""

    scans: list[LidarScan]
    imu: list[ImuBatch]
    wheels: list[WheelOdometry]
    motion: Motion

    def along_m(self, found: Sequence[tuple[int, FloatArray]]) -> FloatArray:
        """Return by how much places (3,) at stamps are off, along the corridor (N,)."""
        truth = self.motion.poses(np.array([stamp_ns for stamp_ns, _ in found]))
        T_world_odom = truth[0]
        places = np.array([place for _, place in found]) @ T_world_odom[:3, :3].T
        return np.asarray((places - places[0])[:, 0] - (truth - truth[0])[:, 0, 3])


@pytest.fixture(scope="module")
def blank() -> Blank:
    lidar = LidarConfig(beams=24, columns=256, max_range_m=12.0)
    world = WLidConfig(length_m=200.0, blank_walls=True, wheel_drift=0.003, lidar=lidar)
    end_ns = START_NS + 4_000_000_000
    records = takewhile(lambda record: record.log_ns <= end_ns, w_lid(world, 0).records)
    messages = [record.message for record in records]
    return Blank(
        [each for each in messages if isinstance(each, LidarScan)],
        [each for each in messages if isinstance(each, ImuBatch)],
        [each for each in messages if isinstance(each, WheelOdometry)],
        drive(Ring(world.length_m), world),
    )


async def followed(blank: Blank, name: str) -> list[Odometry]:
    if name == "kiss":
        out = await run_operator(KissOdometry(KissOdometryConfig()), scans=blank.scans)
    elif name == "gicp":
        out = await run_operator(GicpOdometry(GicpOdometryConfig()), scans=blank.scans)
    else:
        quiet = ImuConfig(gyro_density=1.7e-4, accel_density=2e-3)
        operator = LidarInertialOdometry(LidarInertialOdometryConfig(imu=quiet))
        out = await run_operator(operator, scans=blank.scans, imu=blank.imu)
    return list(out["odometry"])


@pytest.mark.slow
@pytest.mark.anyio
@pytest.mark.parametrize("name", ["kiss", "gicp", "inertial"])
async def test_U8_wheels_take_the_axis_that_a_blank_corridor_leaves_open(
    blank: Blank, name: str
) -> None:
    """Along the axis below 1 % of the way."""
    odometry = await followed(blank, name)
    found = [open_directions(np.array(each.covariance)) for each in odometry[15:]]
    is_axis = [
        len(unseen) == 1 and abs((each.T_odom_base.R @ unseen[0, 3:])[0]) > 0.98
        for each, unseen in zip(odometry[15:], found, strict=True)
    ]
    assert np.mean(is_axis) > 0.9

    config = TrajectoryConfig(
        sources={
            "odometry": OdometryConfig(kind="odometry"),
            "wheels": WheelConfig(kind="wheel"),
        },
        period_s=0.3,
    )
    trajectory = Trajectory(config)
    out = await run_operator(trajectory, config=config, odometry=odometry, wheels=blank.wheels)
    solved = await run_operator(Optimizer(OptimizerConfig()), submaps=out["submaps"])

    vertices = solved["maps"][-1].vertices
    places = list(zip(vertices.stamp_ns.tolist(), vertices.T_mission_base[:, :3, 3], strict=True))
    errors_m = np.abs(blank.along_m(places))
    way_m = np.linalg.norm(np.diff(vertices.T_mission_base[:, :3, 3], axis=0), axis=1).sum()
    assert errors_m.max() < 0.01 * way_m
