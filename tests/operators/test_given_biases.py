"""Odometry that brings velocity and biases along gives vertices a better start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapstream.operators.estimation.batch import optimize_map
from mapstream.operators.testing import run_operator
from mapstream.operators.trajectory.config import ImuConfig, OdometryConfig, TrajectoryConfig
from mapstream.operators.trajectory.trajectory import Trajectory
from mapstream.recordings.maps import Map
from mapstream.recordings.maps.submaps import append_submap
from mapstream.recordings.number_tables import read_stamped_table
from mapstream.recordings.odometry_files import read_odometry
from mapstream.streams.messages.estimates import Odometry
from mapstream.streams.messages.sensors import ImuBatch
from tests.data import shared

pytestmark = pytest.mark.anyio
START_NS, END_NS = 1403715303 * 10**9, 1403715309 * 10**9  # six seconds in the air
CONFIG = TrajectoryConfig(
    sources={"odometry": OdometryConfig(kind="odometry", sigma_rad=0.01, sigma_m=0.02)},
    imu=ImuConfig(gyro_density=1.7e-4, accel_density=2e-3, gyro_random_walk=2e-5),
    period_s=0.5,
)


def recorded() -> tuple[list[Odometry], list[ImuBatch]]:
    """Estimates of EuRoC V1_01 with velocity and biases, and the IMU."""
    folder = shared("euroc_v101_stereo_imu")
    poses = read_odometry(folder / "gt_V1_01_easy_openvins.csv")
    stamps_ns, values = read_stamped_table(folder / "mav0/imu0/data.csv", 6, separator=",")
    here = np.flatnonzero((stamps_ns >= START_NS) & (stamps_ns <= END_NS))
    imu = [
        ImuBatch(stamps_ns=stamps_ns[r], gyro_radps=values[r, :3], accel_mps2=values[r, 3:])
        for r in np.array_split(here, 120)
    ]
    margin_ns = 10**8
    inside = (START_NS + margin_ns, END_NS - margin_ns)
    return [pose for pose in poses if inside[0] <= pose.stamp_ns <= inside[1]], imu


async def mapped(odometry: list[Odometry], imu: list[ImuBatch]) -> Map:
    sent = await run_operator(Trajectory(CONFIG), config=CONFIG, odometry=odometry, imu=imu)
    map_ = Map.empty()
    for submap in sent["submaps"]:
        map_ = append_submap(map_, submap)
    return map_


@pytest.mark.slow
async def test_A10_given_biases_are_those_of_the_vertices_and_save_iterations() -> None:
    given, imu = recorded()
    bare = [
        replace(pose, velocity_mps=None, gyro_bias_radps=None, accel_bias_mps2=None)
        for pose in given
    ]

    with_biases, without = await mapped(given, imu), await mapped(bare, imu)
    optimised, report = optimize_map(with_biases)
    optimised_bare, report_bare = optimize_map(without)

    first = given[0]
    assert first.gyro_bias_radps is not None
    np.testing.assert_allclose(
        with_biases.vertices.gyro_bias_radps[0], first.gyro_bias_radps, atol=1e-4
    )
    assert np.isnan(without.vertices.gyro_bias_radps).all()
    assert report.iterations <= report_bare.iterations
    assert report.error_before < report_bare.error_before
    assert report.error_after == pytest.approx(report_bare.error_after, rel=0.01)
    np.testing.assert_allclose(
        optimised.vertices.gyro_bias_radps, optimised_bare.vertices.gyro_bias_radps, atol=1e-4
    )
